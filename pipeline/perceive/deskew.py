"""Move a sweep's points to its stamp by the radar's velocity, for logs without odometry.

One scan gives the radar's velocity but not the car's yaw rate, because the lever arm is not logged. Points
are therefore moved as if the car drove straight. In a turn the rotation between a point and the stamp
remains: half a degree at 10 deg/s and half a sweep. Lidar-radar leaves such frames out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

__all__ = ["deskew_straight", "velocity_ahead"]


def deskew_straight(
    points_lidar: Float32[np.ndarray, "N 3"],
    time_s: Float32[np.ndarray, " N"],
    velocity_lidar_mps: Float[np.ndarray, " 3"],
) -> Float32[np.ndarray, "N 3"]:
    """Points in the lidar frame at the stamp [m]; velocity in lidar axes, times relative to the stamp."""
    moved = points_lidar + time_s.astype(np.float64)[:, None] * velocity_lidar_mps
    return moved.astype(np.float32)


def velocity_ahead(
    velocity_radar_mps: Float[np.ndarray, " 3"], heading_rad: float
) -> Float[np.ndarray, " 3"]:
    """Level velocity of the car in lidar axes, from that in radar axes without its vertical part.

    `heading_rad` is the azimuth of the lidar's x axis in radar axes.
    """
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    vx, vy = float(velocity_radar_mps[0]), float(velocity_radar_mps[1])
    return np.array([c * vx + s * vy, c * vy - s * vx, 0.0])
