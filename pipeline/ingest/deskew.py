"""De-skew: move the points of a sweep to their positions at the stamp of the sweep."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from pipeline.rig.se3 import inverse, transform_points

__all__ = ["deskew", "planar_motion"]


def deskew(
    points_lidar: Float32[np.ndarray, "N 3"],
    time_s: Float32[np.ndarray, " N"],
    speed_mps: float,
    yaw_rate_radps: float,
    T_vehicle_lidar: Float[np.ndarray, "4 4"],
) -> Float32[np.ndarray, "N 3"]:
    """Points in the lidar frame at the stamp, for a vehicle of constant speed and yaw rate during the sweep.

    Args:
        time_s: of each point, relative to the stamp.
        speed_mps: forward speed of the vehicle frame's origin.
        yaw_rate_radps: positive to the left.
        T_vehicle_lidar: maps lidar coordinates to the vehicle frame (x forward, y left, z up).
    """
    points = transform_points(T_vehicle_lidar, points_lidar.astype(np.float64))
    yaw, shift_x, shift_y = planar_motion(time_s.astype(np.float64), speed_mps, yaw_rate_radps)
    c, s = np.cos(yaw), np.sin(yaw)
    moved = np.stack(
        [
            c * points[:, 0] - s * points[:, 1] + shift_x,
            s * points[:, 0] + c * points[:, 1] + shift_y,
            points[:, 2],
        ],
        -1,
    )
    return transform_points(inverse(T_vehicle_lidar), moved).astype(np.float32)


def planar_motion(
    time_s: Float[np.ndarray, " N"], speed_mps: float, yaw_rate_radps: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Yaw [rad] and position [m] of the vehicle on a circular arc, relative to its pose at time 0."""
    yaw = yaw_rate_radps * time_s
    # sin(a)/a and (1-cos(a))/a through sinc: exact on a straight line too
    half = np.sinc(yaw / (2 * np.pi))
    return yaw, speed_mps * time_s * half * np.cos(yaw / 2), speed_mps * time_s * half * np.sin(yaw / 2)
