"""Planar motion between two sweeps of a lidar, from upright surfaces in both: points to surfaces.

Source: Chen, Medioni 1992 (point to plane); the start comes from a grid of distances and rotations (Olson 2009).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

__all__ = ["Arc", "Surfaces", "motions", "surfaces_of"]

_VOXEL_M, _NEAREST_M, _REACH_M = 0.25, 3.0, 50.0
_NEIGHBOURS, _NEIGHBOURS_M = 8, 1.2  # of a point, to find its surface
_FLAT, _UPRIGHT, _ROAD = (
    0.1,
    0.5,
    0.8,
)  # least over middle variance; vertical part of a normal: surface, no road
_MOST_POINTS, _COARSE_POINTS, _COARSE_OTHERS = 4000, 500, 20_000
_FASTEST_MPS, _BACKWARDS_M, _STEP_M, _TURNS_RAD = 45.0, 2.0, 0.5, (-0.06, -0.02, 0.02, 0.06)
_COARSE_M, _MATCHED_M = 0.7, (2.0, 1.0, 0.5, 0.5, 0.5)
_APART_M, _DISTINCT = 1.5, 1.1  # as in calibrate's sweep_motion: so much better than ways so far away
_SIGMA_M: Final = 0.05  # of a rest while registering; beyond it weighs less (Cauchy)
_FEWEST: Final = 200


class Arc(NamedTuple):
    """Pose of the lidar of the later sweep in the earlier one [m, rad], or its rate per second."""

    x: float
    y: float
    yaw_rad: float

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the later sweep's axes to the earlier one's."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def way(self) -> float:
        """Distance [m]; or speed."""
        return float(np.hypot(self.x, self.y))

    def moved(self, xyz_m: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points of the later sweep, in the frame of the earlier one."""
        return np.asarray(xyz_m @ self.rotation.T + [self.x, self.y, 0.0])


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of a sweep on upright surfaces; `others` has all points except the road, thinned."""

    xyz_m: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    others: Float[np.ndarray, "M 3"]
    tree: cKDTree


def surfaces_of(xyz_m: np.ndarray) -> Surfaces:
    """Upright surfaces of a sweep."""
    far_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    near = np.isfinite(xyz_m).all(1) & (far_m > _NEAREST_M) & (far_m < _REACH_M)
    xyz = xyz_m[near].astype(np.float64)
    cell = np.floor(xyz / _VOXEL_M).astype(np.int64) @ [1, 1 << 12, 1 << 24]
    xyz = xyz[np.unique(cell, return_index=True)[1]]
    if len(xyz) < _NEIGHBOURS:
        return Surfaces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), cKDTree(np.zeros((0, 3))))
    distance, near = cKDTree(xyz).query(xyz, k=_NEIGHBOURS)
    around = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal, up = axes[:, :, 0], np.abs(axes[:, 2, 0])
    flat = (variance[:, 0] < _FLAT * variance[:, 1]) & (up < _UPRIGHT) & (distance[:, -1] < _NEIGHBOURS_M)
    return Surfaces(xyz[flat], normal[flat], xyz[up < _ROAD], cKDTree(xyz[flat]))


def motions(surfaces: Mapping[int, Surfaces], pairs: Sequence[tuple[int, int, float]]) -> dict[int, Arc]:
    """Motion per second at each sweep of a pair (earlier, later, seconds between): the mean of its pairs.

    The best arc of a grid must be clearly better than others, because along the rails of a motorway all distances
    fit equally well; sweeps that do not determine it have no motion.
    """
    held: dict[int, list[Arc]] = {}
    before: tuple[int, Arc, float] | None = None
    for i, j, gap_s in pairs:
        first, last = surfaces[i], surfaces[j]
        start = arc = None
        if min(len(first.xyz_m), len(last.xyz_m)) >= _FEWEST:
            start = _coarse(first, last, gap_s)
            if start is None and before is not None and before[0] == i:
                start = Arc(*(v * gap_s / before[2] for v in before[1]))
        if start is not None:
            arc = _matched(first, last, start)
        before = None if arc is None else (j, arc, gap_s)
        if arc is not None:
            for k in (i, j):
                held.setdefault(k, []).append(Arc(*(v / gap_s for v in arc)))
    return {k: Arc(*np.mean(of, axis=0)) for k, of in held.items()}


def _matched(first: Surfaces, last: Surfaces, start: Arc) -> Arc | None:
    """The best arc near a start, by robust least squares, with one step for each matching distance."""
    some = _thinned(np.arange(len(last.xyz_m)), _MOST_POINTS)
    arc = start
    for reach in _MATCHED_M:
        moved = arc.moved(last.xyz_m[some])
        distance, near = first.tree.query(moved, distance_upper_bound=reach)
        at = np.flatnonzero(np.isfinite(distance))
        near, moved = near[at], moved[at]
        n = first.normal[near]
        rest = np.einsum("nd,nd->n", n, moved - first.xyz_m[near])
        J = np.stack([n[:, 0], n[:, 1], n[:, 1] * moved[:, 0] - n[:, 0] * moved[:, 1]], axis=1)
        weight = 1 / (1 + (rest / _SIGMA_M) ** 2)
        step = np.linalg.solve(J.T @ (J * weight[:, None]) + 1e-6 * np.eye(3), -J.T @ (weight * rest))
        after = Arc(*step)
        x, y, _ = after.moved(np.array([[arc.x, arc.y, 0.0]]))[0]
        before, arc = arc, Arc(float(x), float(y), arc.yaw_rad + after.yaw_rad)
    return before if len(rest) >= _FEWEST else None


def _coarse(first: Surfaces, last: Surfaces, gap_s: float) -> Arc | None:
    """The best of a grid of arcs, if arcs of other distances are clearly worse."""
    tree, few = cKDTree(_thinned(first.others, _COARSE_OTHERS)), _thinned(last.others, _COARSE_POINTS)

    def score(arc: Arc) -> float:
        distance = tree.query(arc.moved(few), distance_upper_bound=_COARSE_M)[0]
        return float(1 - np.minimum(distance / _COARSE_M, 1.0).mean())

    scores = {arc: score(arc) for arc in _grid(gap_s)}
    best = max(scores, key=lambda arc: scores[arc])
    far = max(s for arc, s in scores.items() if abs(arc.x - best.x) > _APART_M)
    return best if scores[best] > _DISTINCT * far else None


def _grid(gap_s: float) -> Iterator[Arc]:
    for way in np.arange(-_BACKWARDS_M, _FASTEST_MPS * gap_s + _STEP_M, _STEP_M):
        yield from (Arc(float(way), float(way * yaw / 2), yaw) for yaw in _TURNS_RAD)


def _thinned(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]
