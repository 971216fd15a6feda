"""Edges from trees of frames, which most formats hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.rig.edges import EDGE_OF_PAIR, words_of
from pipeline.rig.graph import Edge
from pipeline.rig.transform_tree import TransformTree

__all__ = ["ESTIMATED_EDGES", "ESTIMATED_PAIRS", "pairs_of_tree", "require_frames"]

# The pairs in a prior file; the third pair is their composition.
ESTIMATED_PAIRS = ("camera_lidar", "lidar_radar")
ESTIMATED_EDGES = tuple(EDGE_OF_PAIR[pair] for pair in ESTIMATED_PAIRS)


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
