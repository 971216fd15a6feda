"""Clusters of a scan's moving detections."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int32
from numba import njit

__all__ = ["cluster_moving", "wrapped"]


def cluster_moving(
    xyz_m: Float32[np.ndarray, "M 3"],
    residual_mps: Float[np.ndarray, " M"],
    is_moving: np.ndarray,
    period_mps: float,
    eps_m: float,
    min_points: int = 2,
) -> Int32[np.ndarray, " M"]:
    """Density clusters (DBSCAN) of moving detections in x, y and Doppler; -1 = none.

    `eps_m` metres count as 1 m/s; lengths shrink with range, as azimuth noise spreads far objects sideways.

    Args:
        xyz_m: detections [m].
        residual_mps: range rate over ground; compared modulo `period_mps` where that is positive.
        is_moving: which detections take part.
        period_mps: 0 = unambiguous.
        eps_m: neighbourhood near the car.
        min_points: detections (with itself) that make a core; far cars give a scanning radar two.

    Source: Ester et al. 1996.
    """
    label = np.full(len(xyz_m), -1, np.int32)
    index = np.flatnonzero(is_moving)
    if not len(index):
        return label
    xy = xyz_m[index, :2].astype(np.float64)
    scale = eps_m * (1 + np.hypot(*xy.T) / 60.0)
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=-1) / np.minimum(scale[:, None], scale[None])
    doppler = np.abs(wrapped(residual_mps[index][:, None] - residual_mps[index][None], period_mps))
    near = np.hypot(distance, doppler) <= 1.0
    core = near.sum(1) >= min_points
    label[index] = _connect(near, core)
    return label


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _connect(near: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Labels of the connected cores and the points that they reach."""
    n = len(core)
    label = np.full(n, -1, np.int32)
    stack = np.empty(n, np.int64)
    count = 0
    for seed in range(n):
        if not core[seed] or label[seed] >= 0:
            continue
        label[seed] = count
        stack[0] = seed
        top = 1
        while top:
            top -= 1
            i = stack[top]
            for j in range(n):
                if near[i, j] and label[j] < 0:
                    label[j] = count
                    if core[j]:
                        stack[top] = j
                        top += 1
        count += 1
    return label


def wrapped(value: np.ndarray, period: float) -> np.ndarray:
    """The value nearest to zero that differs by whole periods; unchanged where the period is 0."""
    return value - period * np.round(value / period) if period > 0 else value
