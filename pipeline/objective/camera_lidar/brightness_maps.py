"""Image maps of a camera without labels: offsets to steps of brightness, and where paint may be."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int8, UInt8

from pipeline.rig.cameras import Camera
from schemas.observations import STEP_BELOW, STEP_RIGHT

__all__ = ["Start", "free_ground", "step_offsets"]

_FAR_PX = 10_000  # beyond any image
_COLUMN_PX = 8.0


@dataclass(frozen=True, eq=False)
class Start:
    """A pose that the day's frames are projected with before the right one is known, and its sigma."""

    T_camera_lidar: np.ndarray
    sigma_rad: float


def step_offsets(steps: UInt8[np.ndarray, "H W"], reach_px: int, none: int) -> Int8[np.ndarray, "4 H W"]:
    """Offsets k (of k + 1/2 px) to each pixel's nearest step, by EDGE_* class; `none` out of reach.

    A step shows no side, so left and right have the same offsets, and above and below.
    """
    out = np.empty((4, *steps.shape), np.int8)
    out[:2] = _along_rows((steps & STEP_RIGHT) > 0, reach_px, none)
    out[2:] = _along_rows((steps.T & STEP_BELOW) > 0, reach_px, none).T
    return out


def _along_rows(is_step: Bool[np.ndarray, "H W"], reach_px: int, none: int) -> Int8[np.ndarray, "H W"]:
    column = np.arange(is_step.shape[1])
    behind = np.maximum.accumulate(np.where(is_step, column, -_FAR_PX), axis=1)
    behind = np.pad(behind, ((0, 0), (1, 0)), constant_values=-_FAR_PX)[:, :-1] - column
    ahead = np.minimum.accumulate(np.where(is_step, column, _FAR_PX)[:, ::-1], axis=1)[:, ::-1] - column
    nearest = np.where(2 * ahead + 1 < -2 * behind - 1, ahead, behind)
    return np.where(np.abs(nearest) <= reach_px, nearest, none).astype(np.int8)


def free_ground(xyz_m: Float[np.ndarray, "N 3"], camera: Camera, start: Start) -> Bool[np.ndarray, "H W"]:
    """Pixels that may show the ground that the lidar finds free; `camera` is at the maps' size.

    From the far end of the free ground in each direction, as the start projects it, down to the picture's lower
    end, and as far around that as one sigma of the start turns it.
    """
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    T = start.T_camera_lidar
    uv, is_seen = camera.project(xyz_m @ T[:3, :3].T + T[:3, 3])
    size = np.array([camera.width_px, camera.height_px])
    uv = np.clip(uv[is_seen], -size, 2 * size)
    columns, of_column = np.unique(uv[:, 0] // _COLUMN_PX, return_inverse=True)
    if len(columns) < 2:
        return mask > 0
    far_end = np.full(len(columns), np.inf)
    np.minimum.at(far_end, of_column.ravel(), uv[:, 1])
    outline = np.column_stack([(columns + 0.5) * _COLUMN_PX, far_end])
    feet = [[outline[-1, 0], camera.height_px], [outline[0, 0], camera.height_px]]
    cv2.fillPoly(mask, [np.round(np.concatenate([outline, feet])).astype(np.int32)], 1)
    reach_px = round(float(camera.K[0, 0]) * start.sigma_rad)
    return np.asarray(cv2.dilate(mask, np.ones((2 * reach_px + 1,) * 2, np.uint8)) > 0)
