"""Clusters of a scan's moving detections."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.sparse.csgraph import connected_components

__all__ = ["cluster_moving", "wrapped"]

_CORE_POINTS = 2  # detections (with itself) that make a core; far cars give a scanning radar two


def cluster_moving(
    xyz_m: Float32[np.ndarray, "M 3"],
    residual_mps: Float[np.ndarray, " M"],
    is_moving: np.ndarray,
    period_mps: float,
    eps_m: float,
) -> Int32[np.ndarray, " M"]:
    """Density clusters (DBSCAN) of moving detections in x, y and Doppler; -1 = none.

    `eps_m` metres count as 1 m/s; lengths shrink with range, because azimuth noise spreads far objects
    sideways. Residuals are range rates over ground, compared modulo `period_mps` if that is positive.
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
    core = near.sum(1) >= _CORE_POINTS
    # Cores are numbered by their first detection; others join the first cluster that reaches them.
    of_core = connected_components(near[core][:, core], directed=False)[1] if core.any() else np.zeros(0, int)
    reached = np.where(near[:, core], of_core, len(index)).min(axis=1, initial=len(index))
    label[index] = np.where(reached < len(index), reached, -1)
    return label


def wrapped(value: np.ndarray, period: float) -> np.ndarray:
    """The value nearest to zero that differs by whole periods; unchanged where the period is 0."""
    return value - period * np.round(value / period) if period > 0 else value
