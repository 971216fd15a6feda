"""Rolling shutter: each lidar point as the image row that shows it saw it.

The rows of an image are exposed from the top to the bottom during the readout time; the frame's time is that of the
middle row. A point on row v of h was exposed ((v + 1/2)/h - 1/2) readouts later, after the car had moved on.
Stamps that mean the first or the last row are half a readout off, which the time offset takes up like any
other clock.

Points are moved once for one pose, not in the loops over poses, because the change of a point's row between
poses changes its delay by only a few hundredths.

Source: Meingast, Geyer, Sastry 2005, section 3 (projection along a row's own pose).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pipeline.rig.cameras import Camera

if TYPE_CHECKING:
    from pipeline.objective.camera_lidar.points import Points

__all__ = ["exposed", "row_delays_s"]

_ROUNDS = 2  # the second moves rows by what the first left: a hundredth of the delay at most


def row_delays_s(v_px: Float[np.ndarray, " N"], height_px: int, readout_s: float) -> Float[np.ndarray, " N"]:
    """Time of image rows after the middle one [s]; rows outside the image count as its border."""
    return (np.clip((v_px + 0.5) / height_px, 0.0, 1.0) - 0.5) * readout_s


def exposed(
    points: Points,
    poses: Float[np.ndarray, "F 12"],
    camera: Camera,
    velocity_lidar: Float[np.ndarray, "F 3"],
    yaw_rate: Float[np.ndarray, " F"],
    readout_s: float,
) -> Points:
    """Points where their image rows saw them.

    Args:
        points: of F frames, at the time of the middle row or as an earlier call left them.
        poses: rows of the 3x4 transform into the camera at the time of the middle row, by frame.
        camera: at the size of the label images.
        velocity_lidar: own velocity in lidar axes [m/s]; the one that an earlier call had.
        yaw_rate: own [rad/s].
        readout_s: from the first row to the last (negative: from the last to the first); 0 puts the points
            back to the time of the middle row.
    """
    frame = np.repeat(np.arange(len(poses)), np.diff(points.start))
    velocity, turn = velocity_lidar[frame], yaw_rate[frame]
    still = _turned(points.xyz_m.astype(np.float64), turn * points.exposure_s)
    still += velocity * points.exposure_s[:, None]
    exposure_s, moved = np.zeros(len(frame)), still
    for _ in range(_ROUNDS if readout_s else 0):
        rows = poses[frame].reshape(-1, 3, 4).astype(np.float64)
        uv, valid = camera.project(np.einsum("nij,nj->ni", rows[:, :, :3], moved) + rows[:, :, 3])
        exposure_s = np.where(valid, row_delays_s(uv[:, 1], camera.height_px, readout_s), 0.0)
        # The car was there `exposure_s` later, so static objects were nearer by its motion.
        moved = _turned(still - velocity * exposure_s[:, None], -turn * exposure_s)
    return replace(
        points,
        xyz_m=np.ascontiguousarray(moved, np.float32),
        exposure_s=exposure_s.astype(np.float32),
    )


def _turned(points: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Each point turned about the lidar's vertical by its own angle."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = points[:, 0], points[:, 1]
    return np.stack([c * x - s * y, s * x + c * y, points[:, 2]], -1)
