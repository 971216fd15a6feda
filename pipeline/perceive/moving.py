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
) -> Int32[np.ndarray, " M"]:
    """Density clusters (DBSCAN) of moving detections in x, y and Doppler; -1 = none.

    `eps_m` metres count as 1 m/s; lengths shrink with range, because azimuth noise spreads far objects
    sideways. Residuals are range rates over ground, compared modulo `period_mps` if that is positive. Two
    detections are dense enough, for far cars give a scanning radar no more; so whoever has a neighbour is a core.
    """
    label = np.full(len(xyz_m), -1, np.int32)
    index = np.flatnonzero(is_moving)
    x, y = xyz_m[index, 0].astype(np.float64), xyz_m[index, 1].astype(np.float64)
    scale = eps_m * (1 + np.hypot(x, y) / 60.0)
    label[index] = _linked(x, y, scale, residual_mps[index], period_mps)
    return label


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _linked(x: np.ndarray, y: np.ndarray, scale: np.ndarray, rate: np.ndarray, period: float) -> np.ndarray:
    """Number of each detection's group, by its first detection; -1 for one without neighbours."""
    first = np.arange(len(x))  # of the group, after the roots are followed
    is_alone = np.ones(len(x), np.bool_)
    for i in range(len(x)):
        for j in range(i):
            reach = min(scale[i], scale[j])
            dx, dy = x[i] - x[j], y[i] - y[j]
            if abs(dx) > reach or abs(dy) > reach:
                continue
            doppler = rate[i] - rate[j]
            if period > 0:
                doppler -= period * np.rint(doppler / period)
            if np.hypot(np.sqrt(dx * dx + dy * dy) / reach, doppler) <= 1.0:
                is_alone[i] = is_alone[j] = False
                a, b = _first_of(first, i), _first_of(first, j)
                first[max(a, b)] = min(a, b)
    label = np.full(len(x), -1, np.int32)
    groups = 0
    for i in range(len(x)):
        if is_alone[i]:
            continue
        if first[i] == i:
            label[i] = groups
            groups += 1
        else:  # its first is earlier, and numbered
            label[i] = label[first[i]]
    return label


@no_type_check
@njit(cache=True)
def _first_of(first: np.ndarray, i: int) -> int:
    while first[i] != i:
        i = first[i]
    return i


def wrapped(value: np.ndarray, period: float) -> np.ndarray:
    """The value nearest to zero that differs by whole periods; unchanged if the period is 0."""
    return value - period * np.round(value / period) if period > 0 else value
