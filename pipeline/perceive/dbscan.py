"""DBSCAN on a voxel grid, the same clusters as the textbook algorithm in linear time.

Source: Ester, Kriegel, Sander, Xu, "A density-based algorithm for discovering clusters", KDD 1996.
By hand because perception clusters every frame: 13 ms at 19,400 points, where scikit-learn needs 77 and SciPy's
KD-tree 43, and neither gives border points to the nearest core point. Moving detections of a radar have a metric of
their own: place and Doppler.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int32
from numba import njit

__all__ = ["cluster_moving", "dbscan", "in_cells", "wrapped"]

_OWN_RUN_FIRST = (4, 3, 5, 1, 7, 0, 2, 6, 8)  # of the 9 runs of cells: where neighbours are most likely


def dbscan(points: Float[np.ndarray, "N D"], eps: float, min_points: int) -> Int32[np.ndarray, " N"]:
    """Cluster of each point (2-D or 3-D), 0..K-1 in order of first appearance, -1 = noise.

    A core point has at least `min_points` points, itself included, at distance <= eps. A border point that
    several clusters reach joins that of its nearest core point, so that the result does not depend on the
    order of points.
    """
    if not len(points):
        return np.zeros(0, np.int32)
    flat = np.zeros((len(points), 3))
    flat[:, : points.shape[1]] = points
    # Cells of eps: all neighbours of a point lie in the 27 cells around it.
    order, start, key, steps = in_cells(flat, np.array([column.min() for column in flat.T]), eps)
    # Three cells in a row of the last axis have consecutive keys: 9 runs instead of 27 cells.
    first, last = _neighbour_runs(key, *steps)
    sorted_label = _dbscan(np.ascontiguousarray(flat[order]), start, first, last, eps * eps, min_points)
    label = np.empty(len(points), np.int32)
    label[order] = sorted_label
    return _renumber(label)


_Cells = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]


def in_cells(points: Float[np.ndarray, "N 3"], origin: Float[np.ndarray, " 3"], edge: float) -> _Cells:
    """Order of points cell by cell, in their own order within each; a cell begins at `origin`.

    Returns:
        The order; where each occupied cell begins in it, and the end; the key of each occupied cell, ascending; by
        how much the key of the next cell in x, and in y, is larger. The next in z follows by one.
    """
    cell = [np.floor((points[:, k] - origin[k]) / edge).astype(np.int64) for k in range(3)]
    cell = [c - c.min() for c in cell]
    room = [int(c.max()) + 3 for c in cell]  # one cell more on each side: neighbours never wrap
    if room[0] * room[1] * room[2] * len(points) >= 1 << 63:
        # A point astray, kilometres off: wide gaps between occupied layers shrink to one empty layer.
        cell = [_closed_up(c) for c in cell]
        room = [int(c.max()) + 3 for c in cell]
    steps = room[1] * room[2], room[2]
    key = (cell[0] + 1) * steps[0] + (cell[1] + 1) * steps[1] + cell[2] + 1
    bits = len(key).bit_length()
    if room[0] * steps[0] < 1 << (63 - bits):
        # Sorting numbers takes a seventh of the time of sorting places by them stably.
        together = np.sort((key << bits) | np.arange(len(key)))
        key, order = together >> bits, together & ((1 << bits) - 1)
    else:
        order = np.argsort(key, kind="stable")
        key = key[order]
    start = np.flatnonzero(np.diff(key, prepend=-1))
    return order, np.append(start, len(order)), key[start], steps


def _closed_up(layer: np.ndarray) -> np.ndarray:
    """Numbers of layers with gaps of at most two."""
    layers, inverse = np.unique(layer, return_inverse=True)
    return np.append(0, np.cumsum(np.minimum(np.diff(layers), 2)))[inverse]


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _neighbour_runs(key: np.ndarray, step_x: int, step_y: int) -> tuple[np.ndarray, np.ndarray]:
    """For each cell and each of its 9 runs of 3 cells: first and one-past-last cell."""
    first, last = np.empty((len(key), 9), np.int64), np.empty((len(key), 9), np.int64)
    for run in range(9):
        shift = (run // 3 - 1) * step_x + (run % 3 - 1) * step_y
        low, high = 0, 0
        for c in range(len(key)):
            while low < len(key) and key[low] < key[c] + shift - 1:
                low += 1
            high = max(high, low)
            while high < len(key) and key[high] <= key[c] + shift + 1:
                high += 1
            first[c, run], last[c, run] = low, high
    return first, last


@no_type_check
@numba.njit(cache=True)
def _dbscan(
    p: np.ndarray, start: np.ndarray, first: np.ndarray, last: np.ndarray, eps2: float, min_points: int
) -> np.ndarray:
    """Number of a core point of the cluster of each point, -1 = noise; `first` and `last` are cells of runs."""
    n, cells = p.shape[0], len(start) - 1
    core = np.zeros(n, np.bool_)
    for c in range(cells):
        for i in range(start[c], start[c + 1]):
            core[i] = _neighbours_reach(p, i, start, first[c], last[c], eps2, min_points)
    parent = _united(p, start, first, last, eps2, core)
    label = np.full(n, -1, np.int32)
    for c in range(cells):
        for i in range(start[c], start[c + 1]):
            nearest = i if core[i] else _nearest_core(p, i, start, first[c], last[c], eps2, core)
            if nearest >= 0:
                label[i] = _root(parent, nearest)
    return label


@no_type_check
@numba.njit(cache=True)
def _united(
    p: np.ndarray, start: np.ndarray, first: np.ndarray, last: np.ndarray, eps2: float, core: np.ndarray
) -> np.ndarray:
    """Trees of core points in reach of each other: a parent of each, earlier than itself or its own."""
    parent = np.arange(len(p))
    witness = np.full(len(start) - 1, -1)  # a core point of each cell whose core points are all united
    for c in range(len(start) - 1):
        for i in range(start[c], start[c + 1]):
            if core[i]:
                for r in range(9):
                    for other in range(first[c, r], min(last[c, r], c)):
                        _join(p, i, start[other], start[other + 1], witness[other], eps2, core, parent)
                is_split = _join(p, i, start[c], i, witness[c], eps2, core, parent)
                # Whether the cell's core points so far are united changes with this one only.
                if witness[c] < 0 or is_split:
                    witness[c] = _common_core(start[c], i + 1, core, parent)
    return parent


@no_type_check
@numba.njit(cache=True)
def _join(
    p: np.ndarray, i: int, begin: int, end: int, witness: int, eps2: float, core: np.ndarray,
    parent: np.ndarray,
) -> bool:  # fmt: skip
    """Unite a core point with those in reach in a cell; False if `witness`, united with all, is united with it."""
    own = _root(parent, i)
    # Most cells are united with this point already: that costs no look at their points.
    if witness >= 0 and _root(parent, witness) == own:
        return False
    for j in range(end - 1, begin - 1, -1):
        if not core[j] or parent[j] == own:
            continue
        other = _root(parent, j)
        parent[j] = other
        if other != own and _distance2(p, i, j) <= eps2:
            own, other = min(own, other), max(own, other)
            parent[other] = own
            if witness >= 0:
                return False
    return True


@no_type_check
@numba.njit(cache=True)
def _common_core(begin: int, end: int, core: np.ndarray, parent: np.ndarray) -> int:
    """The first core point of a cell if all its core points are united; else -1."""
    found = -1
    for i in range(begin, end):
        if core[i]:
            if found < 0:
                found = i
            elif _root(parent, i) != _root(parent, found):
                return -1
    return found


@no_type_check
@numba.njit(cache=True)
def _nearest_core(
    p: np.ndarray, i: int, start: np.ndarray, first: np.ndarray, last: np.ndarray, eps2: float,
    core: np.ndarray,
) -> int:  # fmt: skip
    nearest, best = -1, eps2
    for r in range(9):
        for j in range(start[first[r]], start[last[r]]):
            d = _distance2(p, i, j)
            if core[j] and (d < best or (d == best and nearest < 0)):
                nearest, best = j, d
    return nearest


@no_type_check
@numba.njit(cache=True)
def _neighbours_reach(
    p: np.ndarray, i: int, start: np.ndarray, first: np.ndarray, last: np.ndarray, eps2: float, wanted: int
) -> bool:
    found = 0
    for r in _OWN_RUN_FIRST:
        for j in range(start[first[r]], start[last[r]]):
            if _distance2(p, i, j) <= eps2:
                found += 1
                if found >= wanted:
                    return True
    return False


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, inline="always")
def _distance2(p: np.ndarray, i: int, j: int) -> float:
    x, y, z = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
    return x * x + y * y + z * z


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _root(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@no_type_check
@numba.njit(cache=True)
def _renumber(label: np.ndarray) -> np.ndarray:
    """Roots to 0..K-1 in order of first appearance."""
    number, found = np.full(len(label), -1, np.int32), np.full(len(label), -1, np.int32)
    clusters = 0
    for i in range(len(label)):
        if label[i] >= 0:
            if number[label[i]] < 0:
                number[label[i]] = clusters
                clusters += 1
            found[i] = number[label[i]]
    return found


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
