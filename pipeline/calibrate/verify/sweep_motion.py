"""Speed and yaw rate of the lidar from pairs of its own sweeps, without odometry, Doppler or calibration.

Standing objects of one sweep are moved along an arc and compared with those of another sweep half a second
later. All speeds and yaw rates of a car are tested on a grid, so there is no start that could be wrong. Rails
and walls match themselves at any speed; so a pair is not used if other, distant arcs are nearly as good as
the best one.

Source: Olson 2009, "Real-time correlative scan matching" (here with one arc for three unknowns).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int64
from numba import njit
from scipy.ndimage import gaussian_filter

from schemas.observations import Observation

__all__ = ["SweepMotion", "occupancy", "occupied_share", "sweep_motion"]

_CELL_M, _REACH_M, _NEAREST_M = 0.5, 60.0, 4.0
_BLUR_CELLS, _FULL = 0.8, 0.2  # a cell with a point counts in full, its neighbours in part
_GAP_S, _LONGEST_GAP_S = 0.5, 0.8  # as long as scenes still overlap: at 0.1 s half a cell is 2.5 m/s
_MOST_PAIRS, _MOST_POINTS, _FEWEST_POINTS = 30, 300, 30
_SPEED_MPS, _YAW_RADPS = 45.0, 0.6
_STEP_M, _STEP_RAD = 0.25, 0.015
_APART_M = 1.5
# By how much the best arc must beat those 1.5 m away. On simulated days of three rigs all of 181 pairs beyond 1.1 were
# right within 1.2 m/s of the odometry, of those below 66 % (highways).
_DISTINCT = 1.1


@dataclass(frozen=True, eq=False)
class SweepMotion:
    """Motion between pairs of sweeps that determine it. Lidar axes: x ahead, positive yaw to the left."""

    first: Int64[np.ndarray, " P"]  # place of the earlier observation
    last: Int64[np.ndarray, " P"]
    speed_mps: Float[np.ndarray, " P"]
    yaw_rate_radps: Float[np.ndarray, " P"]


def sweep_motion(observations: Sequence[Observation]) -> SweepMotion:
    """Motion between sweeps about half a second apart, of at most 30 pairs over the day."""
    pairs = _pairs(observations)
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_PAIRS)).astype(int))]
    found = [
        (i, j, *motion) for i, j in pairs if (motion := _motion(observations[i], observations[j])) is not None
    ]
    first, last, speed, turn = np.array(found, np.float64).reshape(-1, 4).T
    return SweepMotion(first.astype(np.int64), last.astype(np.int64), speed, turn)


def _pairs(observations: Sequence[Observation]) -> Int64[np.ndarray, "P 2"]:
    """Indices of observations of one drive whose sweeps are nearest to half a second apart."""
    stamps_s = np.array([o.stamp_ns for o in observations], np.int64) * 1e-9
    drives = np.array([o.drive for o in observations], np.int64)
    out = []
    for i in range(len(observations) - 1):
        gap = np.where(drives[i + 1 :] == drives[i], stamps_s[i + 1 :] - stamps_s[i], np.inf)
        j = int(np.argmin(np.abs(gap - _GAP_S)))
        if 0 < gap[j] <= _LONGEST_GAP_S:
            out.append((i, i + 1 + j))
    return np.array(out, np.int64).reshape(-1, 2)


def _motion(before: Observation, after: Observation) -> tuple[float, float] | None:
    """Speed and yaw rate from one sweep to the other; None if undetermined."""
    still, moved = _standing(before), _standing(after)
    if min(len(still), len(moved)) < _FEWEST_POINTS:
        return None
    gap_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    speeds = np.arange(-_SPEED_MPS, _SPEED_MPS, _STEP_M / gap_s)
    turns = np.arange(-_YAW_RADPS, _YAW_RADPS, _STEP_RAD / gap_s)
    arcs = _arcs(turns * gap_s, speeds * gap_s)
    moved = moved[:: max(1, len(moved) // _MOST_POINTS)]
    score = _scores(moved, occupancy(still), arcs, _CELL_M, _REACH_M).reshape(len(turns), len(speeds))
    w, v = np.unravel_index(int(np.argmax(score)), score.shape)
    far = np.abs(speeds - speeds[v]) * gap_s > _APART_M
    if score[w, v] < _DISTINCT * score[:, far].max():
        return None
    return float(speeds[v]), float(turns[w])


def _arcs(yaw_rad: Float[np.ndarray, " W"], way_m: Float[np.ndarray, " V"]) -> Float[np.ndarray, "W*V 3"]:
    """Yaw, x and y at the ends of circular arcs, for all combinations of turn and arc length."""
    yaw, way = (a.ravel() for a in np.meshgrid(yaw_rad, way_m, indexing="ij"))
    chord = way * np.sinc(yaw / (2 * np.pi))
    return np.stack([yaw, chord * np.cos(yaw / 2), chord * np.sin(yaw / 2)], 1)


def _standing(o: Observation) -> Float[np.ndarray, "N 2"]:
    """Standing objects around the lidar, one point per cell."""
    xy = o.lidar_map_xyz_m[o.lidar_map_is_ground == 0, :2].astype(np.float64)
    far_m = np.hypot(*xy.T)
    xy = xy[(far_m > _NEAREST_M) & (far_m < _REACH_M)]
    cell = np.floor(xy / _CELL_M).astype(np.int64)
    return xy[np.unique(cell, axis=0, return_index=True)[1]]


def occupancy(xy_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "C C"]:
    """Occupancy around the lidar, 0 to 1, on a grid of half-metre cells."""
    size = int(2 * _REACH_M / _CELL_M)
    grid = np.zeros((size, size))
    row, column = np.floor((xy_m + _REACH_M) / _CELL_M).astype(np.int64).T
    grid[row, column] = 1.0
    return np.asarray(np.minimum(gaussian_filter(grid, _BLUR_CELLS) / _FULL, 1.0))


def occupied_share(o: Observation, xy_lidar_m: Float[np.ndarray, "N 2"]) -> float:
    """Share of another sensor's points in occupied cells, 0 to 1."""
    return float(_scores(xy_lidar_m, occupancy(_standing(o)), np.zeros((1, 3)), _CELL_M, _REACH_M)[0])


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
