"""Objects of one lidar sweep: clusters above the ground, their boxes, and a uniform sample.

Source: paper, section 4.2 (uniform sampling, DBSCAN).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32
from numba import njit

from pipeline.perceive.dbscan import dbscan

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
    range_m = np.linalg.norm(xyz_m, axis=1)
    rows = np.flatnonzero(~is_ground & (range_m > _NEAR_M))
    if len(rows) >= min_points:
        label[rows] = dbscan(_evenly_spaced(xyz_m[rows], range_m[rows]), eps_m, min_points)
    return _by_size(label)


def cluster_boxes(xyz_m: Float32[np.ndarray, "N 3"], label: Int32[np.ndarray, " N"]) -> Boxes:
    """Boxes of all clusters, row k for label k."""
    rows = np.flatnonzero(label >= 0)
    if not rows.size:
        none = np.zeros((0, 3), np.float32)
        return Boxes(none, none, none)
    order = rows[np.argsort(label[rows], kind="stable")]
    points = xyz_m[order]
    start = np.flatnonzero(np.diff(label[order], prepend=-1))
    count = np.diff(np.append(start, len(order)))[:, None]
    centre = np.add.reduceat(points.astype(np.float64), start) / count
    return Boxes(
        centre.astype(np.float32), np.minimum.reduceat(points, start), np.maximum.reduceat(points, start)
    )


def sample_uniformly(xyz_m: Float32[np.ndarray, "N 3"], voxel_m: float) -> Int[np.ndarray, " M"]:
    """Rows of one measured point per voxel, the nearest to the voxel's mean, without the own vehicle.

    Means would lie beside surfaces; a measured point keeps its ring, cluster and reflectivity.
    """
    rows = np.flatnonzero(np.linalg.norm(xyz_m, axis=1) > _NEAR_M)
    if not rows.size:
        return rows
    points = xyz_m[rows].astype(np.float64)
    cell = np.floor(points / voxel_m).astype(np.int64) + (1 << 20)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    return np.sort(rows[order[_nearest_to_means(points[order], np.append(start, len(order)))]])


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _nearest_to_means(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Row of the point nearest to the mean of each run of points; the first where several are."""
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
