"""Registration of two sweeps of one lidar, or of two lidars: an arc from nothing, then points to planes.

The arc: standing objects of one sweep are moved along an arc and compared with those of the other. All speeds and yaw
rates of a car are tested on a grid, so there is no start that could be wrong. Rails and walls match themselves at any
speed; so there is no arc if other, distant ones are nearly as good as the best one.
Source: Olson 2009, "Real-time correlative scan matching" (here with one arc for three unknowns).

Points to planes, from a near start: ground and ceilings constrain height and tilt only. Otherwise their noisy normals
would keep points at the start, which looks like information on horizontal motion on an empty square.
Source: Chen and Medioni 1992, "Object modelling by registration of multiple range images"; Geman-McClure weights with
a scale that follows the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from pipeline.rig.se3 import exp_se3, inverse, log_se3, transform_points

__all__ = [
    "PlaneEquations", "Surfaces", "arc_between", "occupied_share", "one_per_cell", "plane_equations", "register",
]  # fmt: skip

_NEIGHBOURS = 10
_PLANAR = 0.1  # a patch's smallest variance over its middle one: beyond it there is no plane
_LEVEL = 0.8  # cosine between a normal and the vertical from which on a surface is ground, roof or ceiling
_FEWEST = 6 * _NEIGHBOURS
_GATES_M = (2.0, 1.0, 0.5, 0.3)  # pairs of points, from the start's errors down to the maps' spacing
_STEPS = 6
_CONVERGED = 1e-4  # rad, m
_LEAST_SCATTER_M = 0.01  # no car lidar measures better
_CELL_M, _REACH_M, _NEAREST_M = 0.5, 60.0, 4.0
_BLUR_CELLS, _FULL = 0.8, 0.2  # a cell with a point counts in full, its neighbours in part
_MOST_POINTS, _FEWEST_STANDING = 300, 30
_SPEED_MPS, _YAW_RADPS = 45.0, 0.6
_STEP_M, _STEP_RAD = 0.25, 0.015
_APART_M = 1.5
# By how much the best arc must beat those 1.5 m away. On simulated days of three rigs all of 181 pairs beyond 1.1 were
# right within 1.2 m/s of the odometry, of those below 66 % (highways).
_DISTINCT = 1.1


def arc_between(
    still_m: Float[np.ndarray, "N 2"], moved_m: Float[np.ndarray, "M 2"], gap_s: float
) -> tuple[float, float] | None:
    """Speed and yaw rate from one sweep to the other, in the lidar's axes: x ahead, positive yaw to the left.

    Args:
        still_m: standing objects of the earlier sweep, of `one_per_cell`.
        moved_m: of the later sweep.
        gap_s: between their stamps.

    Returns:
        None if they do not determine an arc.
    """
    if min(len(still_m), len(moved_m)) < _FEWEST_STANDING:
        return None
    speeds = np.arange(-_SPEED_MPS, _SPEED_MPS, _STEP_M / gap_s)
    turns = np.arange(-_YAW_RADPS, _YAW_RADPS, _STEP_RAD / gap_s)
    arcs = _arcs(turns * gap_s, speeds * gap_s)
    moved = moved_m[:: max(1, len(moved_m) // _MOST_POINTS)]
    score = _scores(moved, _occupancy(still_m), arcs, _CELL_M, _REACH_M).reshape(len(turns), len(speeds))
    w, v = np.unravel_index(int(np.argmax(score)), score.shape)
    far = np.abs(speeds - speeds[v]) * gap_s > _APART_M
    if score[w, v] < _DISTINCT * score[:, far].max():
        return None
    return float(speeds[v]), float(turns[w])


def occupied_share(still_m: Float[np.ndarray, "N 2"], other_m: Float[np.ndarray, "M 2"]) -> float:
    """Share of another sensor's points in cells of standing objects, 0 to 1."""
    return float(_scores(other_m, _occupancy(still_m), np.zeros((1, 3)), _CELL_M, _REACH_M)[0])


def one_per_cell(xy_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "M 2"]:
    """Points around the lidar, one of each half-metre cell."""
    far_m = np.hypot(*xy_m.T)
    xy_m = xy_m[(far_m > _NEAREST_M) & (far_m < _REACH_M)]
    cell = np.floor(xy_m / _CELL_M).astype(np.int64)
    return xy_m[np.unique(cell, axis=0, return_index=True)[1]]


def _arcs(yaw_rad: Float[np.ndarray, " W"], way_m: Float[np.ndarray, " V"]) -> Float[np.ndarray, "W*V 3"]:
    """Yaw, x and y at the ends of circular arcs, for all combinations of turn and arc length."""
    yaw, way = (a.ravel() for a in np.meshgrid(yaw_rad, way_m, indexing="ij"))
    chord = way * np.sinc(yaw / (2 * np.pi))
    return np.stack([yaw, chord * np.cos(yaw / 2), chord * np.sin(yaw / 2)], 1)


def _occupancy(xy_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "C C"]:
    """Occupancy around the lidar, 0 to 1, on a grid of half-metre cells."""
    size = int(2 * _REACH_M / _CELL_M)
    grid = np.zeros((size, size))
    row, column = np.floor((xy_m + _REACH_M) / _CELL_M).astype(np.int64).T
    grid[row, column] = 1.0
    return np.asarray(np.minimum(gaussian_filter(grid, _BLUR_CELLS) / _FULL, 1.0))


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _scores(
    xy: np.ndarray, occupied: np.ndarray, arcs: np.ndarray, cell_m: float, reach_m: float
) -> np.ndarray:
    """Mean occupancy of points moved by each arc (yaw, x, y); outside of the grid 0."""
    out, size = np.zeros(len(arcs)), len(occupied)
    for k in range(len(arcs)):
        c, s, total = np.cos(arcs[k, 0]), np.sin(arcs[k, 0]), 0.0
        for p in range(len(xy)):
            row = int((c * xy[p, 0] - s * xy[p, 1] + arcs[k, 1] + reach_m) / cell_m)
            column = int((s * xy[p, 0] + c * xy[p, 1] + arcs[k, 2] + reach_m) / cell_m)
            if 0 <= row < size and 0 <= column < size:
                total += occupied[row, column]
        out[k] = total / max(len(xy), 1)
    return out


class Surfaces:
    """Points with the normals of their surfaces."""

    def __init__(self, xyz_m: Float[np.ndarray, "N 3"]) -> None:
        self.xyz_m = xyz_m
        self.tree = cKDTree(xyz_m)
        near = xyz_m[self.tree.query(xyz_m, k=_NEIGHBOURS)[1]]
        near = near - near.mean(1, keepdims=True)
        variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
        self.normal = np.ascontiguousarray(axes[:, :, 0])
        self.is_planar = variance[:, 0] < _PLANAR * variance[:, 1]

    @classmethod
    def of(cls, xyz_m: Float[np.ndarray, "N 3"]) -> Surfaces | None:
        """The surfaces of a cloud; None for a cloud with too few points."""
        return cls(xyz_m) if len(xyz_m) >= _FEWEST else None


@dataclass(frozen=True, eq=False)
class PlaneEquations:
    """Equations of points near surfaces, for a left perturbation (rotation, shift)."""

    information: np.ndarray  # 6 6
    gradient: np.ndarray  # 6, downhill
    scatter_m: float  # of points from the surfaces
    share: float  # of the points that lie on a surface


def register(
    source_m: Float[np.ndarray, "N 3"],
    target: Surfaces,
    start: Float[np.ndarray, "4 4"],
    sigmas: Float[np.ndarray, " 6"],
) -> tuple[Float[np.ndarray, "4 4"], PlaneEquations] | None:
    """Find T_target_source, and the equations of the data alone there.

    Args:
        sigmas: sigmas of the start, for left perturbations; directions that no surface constrains stay at the
            start.

    Returns:
        None if hardly any point meets a surface.
    """
    T, held = start, np.diag(sigmas**-2.0)
    found = None
    for gate in _GATES_M:
        for _ in range(_STEPS):
            found = plane_equations(transform_points(T, source_m), target, gate)
            if found is None:
                return None
            downhill = found.gradient + held @ log_se3(start @ inverse(T))
            step = np.linalg.solve(found.information + held, downhill)
            T = exp_se3(step) @ T
            if np.abs(step).max() < _CONVERGED:
                break
    return None if found is None else (T, found)


def plane_equations(
    moved_m: Float[np.ndarray, "N 3"], target: Surfaces, gate_m: float
) -> PlaneEquations | None:
    """Robust equations of the points with a plane within the gate; None if there are too few."""
    distance, index = target.tree.query(moved_m, distance_upper_bound=gate_m)
    meets = np.isfinite(distance)
    meets[meets] = target.is_planar[index[meets]]
    if meets.sum() < _FEWEST:
        return None
    p, n, q = moved_m[meets], target.normal[index[meets]], target.xyz_m[index[meets]]
    r = np.einsum("ij,ij->i", n, p - q)
    # Of level surfaces only the vertical part is believed.
    level = np.abs(n[:, 2]) > _LEVEL
    n[level, :2] = 0.0
    J = np.concatenate([np.cross(p, n), n], 1)
    scatter = max(1.4826 * float(np.median(np.abs(r))), _LEAST_SCATTER_M)
    w = (1 + (r / (2 * scatter)) ** 2) ** -2 / scatter**2
    return PlaneEquations((J.T * w) @ J, -(J.T * w) @ r, scatter, float(meets.mean()))
