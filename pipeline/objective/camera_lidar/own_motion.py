"""The car's own motion while camera and lidar see the same scene at different times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from pipeline.objective.ego_motion import shown_heading
from schemas.observations import Observation

__all__ = ["lidar_velocities", "motion_in_camera", "moving_poses"]


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def moving_poses(
    R: np.ndarray,
    t: np.ndarray,
    dt_s: np.ndarray,
    gap_s: np.ndarray,
    velocity: np.ndarray,
    yaw_rate: np.ndarray,
) -> np.ndarray:
    """[R Rz(yaw_rate tau) | R Rz(yaw_rate tau) v tau + t] as rows, tau = dt - gap, for each pose and frame."""
    count, frames = R.shape[0], velocity.shape[0]
    out = np.empty((count, frames, 12), np.float32)
    for p in range(count):
        for f in range(frames):
            tau = dt_s[p] - gap_s[f]
            c, s = np.cos(yaw_rate[f] * tau), np.sin(yaw_rate[f] * tau)
            for i in range(3):
                a, b, d = c * R[p, i, 0] + s * R[p, i, 1], c * R[p, i, 1] - s * R[p, i, 0], R[p, i, 2]
                ahead = a * velocity[f, 0] + b * velocity[f, 1] + d * velocity[f, 2]
                row = 4 * i
                out[p, f, row], out[p, f, row + 1], out[p, f, row + 2] = a, b, d
                out[p, f, row + 3] = ahead * tau + t[p, i]
    return out


def motion_in_camera(
    poses: Float[np.ndarray, "F 12"],
    t_camera_lidar: Float[np.ndarray, " 3"],
    velocity_lidar: Float[np.ndarray, "F 3"],
    yaw_rate: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "F 4"]:
    """Velocity in camera axes and yaw rate: a point moves by velocity + yaw_rate up x (point - pose's translation)."""
    rows = poses.reshape(-1, 3, 4)
    # The turn is about the lidar, which is where the pose's translation was before the way driven.
    turn = yaw_rate[:, None] * np.cross(rows[:, :, 2], rows[:, :, 3] - t_camera_lidar)
    velocity = np.einsum("fij,fj->fi", rows[:, :, :3], velocity_lidar) + turn
    return np.column_stack([velocity, yaw_rate])


def lidar_velocities(
    observations: Sequence[Observation],
    T_lidar_radar: Float[np.ndarray, "4 4"],
    heading_rad: float | None = None,
) -> Float[np.ndarray, "F 3"]:
    """Own velocity in lidar axes [m/s]: the speed along one heading of the day, in the horizontal plane.

    Args:
        observations: whose speeds are taken, 0 where unknown.
        T_lidar_radar: turns the radar's Doppler into the heading; where no radar shows it, it is the lidar's
            x axis.
        heading_rad: azimuth of the heading where it is known otherwise.
    """
    speed = np.array([o.ego_speed_mps if o.ego_speed_mps is not None else 0.0 for o in observations])
    heading = (shown_heading(observations, T_lidar_radar) or 0.0) if heading_rad is None else heading_rad
    return speed[:, None] * np.array([np.cos(heading), np.sin(heading), 0.0])
