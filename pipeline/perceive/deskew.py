"""Move a sweep's points to its stamp where no odometry did: along the radar's velocity, as far as that is known.

One scan tells how fast the radar moves and where to, not how the car turns: sideways it moves by yaw rate times a lever
arm that nobody logged. So points are moved as if the car drove straight. In a turn that leaves what the car turned
between a point and the stamp, as it was before: half a degree at 10 deg/s and half a sweep; lidar-radar leaves such
frames out.
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
    """Points in the lidar frame at the stamp [m], each given in the lidar frame at its own time.

    Args:
        points_lidar: as logged [m].
        time_s: of each point, relative to the stamp.
        velocity_lidar_mps: of the lidar, in its own axes.
    """
    moved = points_lidar + time_s.astype(np.float64)[:, None] * velocity_lidar_mps
    return moved.astype(np.float32)


def velocity_ahead(
    velocity_radar_mps: Float[np.ndarray, " 3"], heading_rad: float
) -> Float[np.ndarray, " 3"]:
    """The car's velocity in lidar axes, level, from the radar's.

    Args:
        velocity_radar_mps: in radar axes; its vertical part is no measurement, and is left out.
        heading_rad: azimuth of the lidar's x axis in radar axes.
    """
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    vx, vy = float(velocity_radar_mps[0]), float(velocity_radar_mps[1])
    return np.array([c * vx + s * vy, c * vy - s * vx, 0.0])
