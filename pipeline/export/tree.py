"""Edges from trees of frames, which most formats hold; rotations in other conventions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.rig.graph import EDGE_OF_PAIR, Edge, words_of
from pipeline.rig.se3 import from_rotation_translation
from pipeline.rig.transform_tree import TransformTree

__all__ = [
    "ESTIMATED_EDGES",
    "ESTIMATED_PAIRS",
    "T_LINK_OPTICAL",
    "pairs_of_tree",
    "pose_of_rpy",
    "require_frames",
    "rpy_of",
]

# The pairs in a prior file; the third pair is their composition.
ESTIMATED_PAIRS = ("camera_lidar", "lidar_radar")
ESTIMATED_EDGES = tuple(EDGE_OF_PAIR[pair] for pair in ESTIMATED_PAIRS)
# Axes of the optical frame (x right, y down, z forward) in the camera's link (x forward, y left, z up), REP
# 103: roll, pitch, yaw = -pi/2, 0, -pi/2, here without rounding.
T_LINK_OPTICAL = from_rotation_translation(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)


def pairs_of_tree(
    file: str, tree: TransformTree, names: FrameNames, edges: Sequence[Edge]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """T_parent_child by edge name, of those edges whose frames the tree connects.

    Raises:
        ConfigError: no edge found (the message lists the file's frames), or a frame occurs twice.
    """
    twice = sorted(tree.twice & {names.of(s.name) for edge in edges for s in edge.sensors})
    if twice:
        raise ConfigError(file, twice[0], "occurs twice, with different poses: give one calibration")
    found = {}
    for edge in edges:
        T = tree.lookup(names.of(edge.parent.name), names.of(edge.child.name))
        if T is not None:
            found[words_of(edge)] = T
    if not found:
        frames = sorted({*tree.edges, *tree.edges.values()})
        asked = dict.fromkeys(names.of(sensor.name) for edge in edges for sensor in edge.sensors)
        raise ConfigError(
            file,
            ", ".join(asked),
            f"no chain joins these frames; the file has: {', '.join(frames) or 'none'}. "
            "Name them with --camera-frame, --lidar-frame, --radar-frame, or --frame SENSOR=NAME",
        )
    return found


def require_frames(file: str, parent: object, child: object) -> tuple[str, str]:
    """Two frame names of a file, without ROS 1's leading slash; ConfigError if invalid or equal."""
    if not (isinstance(parent, str) and isinstance(child, str)):
        raise ConfigError(file, "parent, child", f"{parent!r} and {child!r} are not frame names")
    parent, child = parent.lstrip("/"), child.lstrip("/")
    if not parent or not child or parent == child:
        raise ConfigError(file, "parent, child", f"{parent!r} and {child!r} must be two different frames")
    return parent, child


def rpy_of(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Roll, pitch, yaw [rad] about fixed axes x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll).

    Each angle is computed from the rotation that remains after the previous ones. So the three reproduce R to
    rounding, even at a pitch of +-90 deg, where roll and yaw are not unique.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def pose_of_rpy(xyz_m: Float[np.ndarray, " 3"], rpy_rad: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """T_parent_child from a position and from roll, pitch, yaw about fixed axes, as in URDF and Autoware."""
    return from_rotation_translation(Rotation.from_euler("xyz", rpy_rad).as_matrix(), xyz_m)
