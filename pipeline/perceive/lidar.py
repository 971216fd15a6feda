"""Objects of one lidar sweep: clusters above the ground, their boxes, and a uniform sample.

Source: paper, section 4.2 (uniform sampling, DBSCAN).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32
from numba import njit

from pipeline.perceive.dbscan import dbscan, in_cells

__all__ = ["Boxes", "cluster_boxes", "cluster_objects", "sample_uniformly"]

_NEAR_M = 2.5  # nearer returns are the vehicle itself
_LOG_FROM_M = 12.0  # from here on distances shrink like the beams spread
_VERTICAL = 0.5  # rings lie further apart than points along a ring, and objects stand upright


@dataclass(frozen=True, eq=False)
class Boxes:
    """Axis-aligned boxes of clusters 0..K-1, and the mean of their points [m]."""

    centre_m: Float32[np.ndarray, "K 3"]
    min_m: Float32[np.ndarray, "K 3"]
    max_m: Float32[np.ndarray, "K 3"]


def cluster_objects(
    xyz_m: Float32[np.ndarray, "N 3"], is_ground: Bool[np.ndarray, " N"], eps_m: float, min_points: int
) -> Int32[np.ndarray, " N"]:
    """DBSCAN label of each point, 0..K-1 in order of size (largest first), -1 = ground, own car or noise.

    Beyond 12 m ranges are compressed logarithmically, so that `eps_m` grows with the gap between beams;
    heights are halved (see _VERTICAL).
    """
    label = np.full(len(xyz_m), -1, np.int32)
    range_m = _lengths(xyz_m)
    rows = np.flatnonzero(~is_ground & (range_m > _NEAR_M))
    if len(rows) >= min_points:
        label[rows] = dbscan(_evenly_spaced(xyz_m[rows], range_m[rows]), eps_m, min_points)
    return _by_size(label)


def cluster_boxes(xyz_m: Float32[np.ndarray, "N 3"], label: Int32[np.ndarray, " N"]) -> Boxes:
    """Boxes of all clusters, row k for label k."""
    if not (label >= 0).any():
        none = np.zeros((0, 3), np.float32)
        return Boxes(none, none, none)
    return Boxes(*_boxes(xyz_m, label, int(label.max()) + 1))


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _boxes(xyz: np.ndarray, label: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, least and greatest coordinates of each label."""
    total, points = np.zeros((count, 3)), np.zeros(count)
    low = np.full((count, 3), np.inf, np.float32)
    high = np.full((count, 3), -np.inf, np.float32)
    for i in range(len(xyz)):
        k = label[i]
        if k < 0:
            continue
        points[k] += 1
        for a in range(3):
            total[k, a] += xyz[i, a]
            low[k, a], high[k, a] = min(low[k, a], xyz[i, a]), max(high[k, a], xyz[i, a])
    return (total / points.reshape(-1, 1)).astype(np.float32), low, high


def sample_uniformly(xyz_m: Float32[np.ndarray, "N 3"], voxel_m: float) -> Int[np.ndarray, " M"]:
    """Rows of one measured point per voxel, the nearest to the voxel's mean, without the own vehicle.

    A mean of points need not lie on a surface. A measured point does, and keeps its ring, cluster and reflectivity.
    """
    rows = np.flatnonzero(_lengths(xyz_m) > _NEAR_M)
    if not rows.size:
        return rows
    points = xyz_m[rows].astype(np.float64)
    order, start, *_ = in_cells(points, np.zeros(3), voxel_m)
    return np.sort(rows[order[_nearest_to_means(points[order], start)]])


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _nearest_to_means(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Row of the point nearest to the mean of each run of points; the first of equally near ones."""
    chosen = np.empty(len(start) - 1, np.int64)
    for v in range(len(chosen)):
        begin, end = start[v], start[v + 1]
        x, y, z = 0.0, 0.0, 0.0
        for i in range(begin, end):
            x, y, z = x + points[i, 0], y + points[i, 1], z + points[i, 2]
        x, y, z = x / (end - begin), y / (end - begin), z / (end - begin)
        best = np.inf
        for i in range(begin, end):
            d = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if d < best:
                best, chosen[v] = d, i
    return chosen


def _lengths(xyz_m: np.ndarray) -> np.ndarray:
    """Ranges; np.linalg.norm takes five times as long along so short an axis."""
    x, y, z = xyz_m.T
    return np.sqrt(x * x + y * y + z * z)


def _evenly_spaced(xyz_m: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    log_range = _LOG_FROM_M * (1 + np.log(np.maximum(range_m, _LOG_FROM_M) / _LOG_FROM_M))
    shrink = np.where(range_m > _LOG_FROM_M, log_range / range_m, 1.0)
    return xyz_m * shrink[:, None] * np.array([1.0, 1.0, _VERTICAL])


def _by_size(label: np.ndarray) -> np.ndarray:
    sizes = np.bincount(label[label >= 0])
    rank = np.empty(len(sizes) + 1, np.int32)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    rank[-1] = -1
    return rank[label]
