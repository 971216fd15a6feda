"""Rotations in other conventions: roll, pitch, yaw of URDF and ROS, and a camera's link and optical frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipeline.rig.se3 import from_rotation_translation

__all__ = ["T_LINK_OPTICAL", "pose_of_rpy", "rpy_of"]

# Axes of the optical frame (x right, y down, z forward) in the camera's link (x forward, y left, z up), REP
# 103: roll, pitch, yaw = -pi/2, 0, -pi/2, here without rounding.
T_LINK_OPTICAL = from_rotation_translation(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)


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
