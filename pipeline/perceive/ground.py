"""Ground under the vehicle in one lidar sweep: a plane, its points, and the free ground around.

RANSAC uses the lowest point of each cell of a grid over the ground, so that neither the dense rings around
the vehicle nor walls dominate the road. Then each sector follows the surface outwards, because roads bend and
crown. With a point model, RANSAC uses road points only, the surface has no object points, and the drivable
area ends with the road.

Source: paper, section 4.2 (RangeNet++ and RANSAC successively; geometry alone without a model).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, no_type_check, runtime_checkable

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

__all__ = ["Ground", "PointKind", "PointSource", "find_ground", "height_over", "kth_smallest", "median_of"]

_NEAR_M = 2.5  # nearer returns are the vehicle itself
_FAR_M = 60.0  # a 0.2 deg grazing angle and less: no ground returns worth a plane
_CELL_M = 1.0
_GRID_CELLS = 2 * (int(_FAR_M / _CELL_M) + 1)
_PLANE_REACH_M = 35.0  # further out a plane is a poor model of a road
_MAX_TILT_RAD = 0.26  # 15 deg: mounting plus road; a steeper "ground" is a bank or a wall
_HEIGHT_RANGE_M = (0.3, 4.0)  # lidar above the road: bumper to truck roof
_HYPOTHESES = 800
_TRUSTED_AHEAD_M, _TRUSTED_ASIDE_M = 10.0, 3.0
_FLAT_M = 0.25
_MIN_SUPPORT = 40  # cells of 1 m^2
_SECTORS = 120
_BIN_M = 1.5
_SLOPE = 0.06  # change of gradient along a sector that is still the same surface
_OBSTACLE_M = (0.35, 2.5)  # above the local ground: over kerbs, under signs and branches
_FREE_BINS = 360


class PointKind(IntEnum):
    """Class of a lidar point by a model; geometry decides unknown ones."""

    UNKNOWN = 0
    ROAD = 1
    FLAT = 2  # ground that is no road: sidewalk, grass
    ROAD_USER = 3
    OTHER = 4


@runtime_checkable
class PointSource(Protocol):
    """Source of point classes, sweep by sweep."""

    provenance: dict[str, Any]  # what of it belongs into the work key

    def kinds(
        self, xyz_m: Float32[np.ndarray, "N 3"], intensity: Float32[np.ndarray, " N"] | None
    ) -> UInt8[np.ndarray, " N"]:
        """The PointKind of each point."""
        ...


@dataclass(frozen=True, eq=False)
class Ground:
    """`plane` (n, d) with n.p + d = 0, n up, lidar frame; None if none was found.

    `is_road` are the ground points that a model classifies as road; all of them without a model.
    """

    plane: Float[np.ndarray, " 4"] | None
    is_ground: Bool[np.ndarray, " N"]
    is_road: Bool[np.ndarray, " N"]
    drivable_xyz_m: Float32[np.ndarray, "M 3"]


def find_ground(
    xyz_m: Float32[np.ndarray, "N 3"],
    inlier_m: float,
    rng: np.random.Generator,
    kind: UInt8[np.ndarray, " N"] | None = None,
) -> Ground:
    """Plane, ground points and reachable ground on a 1 m grid of one sweep (lidar frame, z roughly up).

    `inlier_m` is the largest distance of ground points from the surface, near the vehicle. `kind` is the
    PointKind of each point by a model; None = geometry alone.
    """
    every = np.ones(len(xyz_m), bool)
    road = every if kind is None else kind == PointKind.ROAD
    labelled = ~every if kind is None else road | (kind == PointKind.FLAT)
    may_be_ground = every if kind is None else labelled | (kind == PointKind.UNKNOWN)
    azimuth, range_m = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]), np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    seen = (range_m > _NEAR_M) & (range_m < _FAR_M)
    near = road & (range_m > _NEAR_M) & (range_m < _PLANE_REACH_M)
    plane = _fit_plane(*_lowest_of_cells(xyz_m, near), inlier_m, rng)
    if plane is None:  # too little road: what a model calls ground is no object all the same
        return Ground(None, labelled & seen, labelled & road & seen, np.zeros((0, 3), np.float32))
    above_local = _follow_surface(azimuth, range_m, height_over(plane, xyz_m), inlier_m, may_be_ground)
    # Range noise on a grazing beam and ring tilt show as height: 0.3 % of the range.
    on_surface = np.abs(above_local) < inlier_m + 0.003 * range_m
    # Grass is rough, and a model classifies it as ground; higher points are mistakes.
    near_surface = np.abs(above_local) < _OBSTACLE_M[0] + 0.003 * range_m
    is_ground = seen & np.where(labelled, near_surface, on_surface & may_be_ground)
    is_road = seen & road & on_surface
    blocks = (above_local > _OBSTACLE_M[0]) & (above_local < _OBSTACLE_M[1])
    if kind is not None:  # a road user blocks by its feet and wheels too
        user = (kind == PointKind.ROAD_USER) & (above_local < _OBSTACLE_M[1])
        blocks = (blocks & ~is_ground) | user
    # Reachable is what has no nearer obstacle in its direction; the own vehicle is none.
    direction = np.minimum(((azimuth + np.pi) / (2 * np.pi) * _FREE_BINS).astype(np.int32), _FREE_BINS - 1)
    free = range_m < _second_nearest(direction, range_m, blocks & (range_m > _NEAR_M))[direction]
    return Ground(plane, is_ground, is_road, _on_grid(xyz_m, is_road & free))


def height_over(
    plane: Float[np.ndarray, " 4"], xyz_m: Float32[np.ndarray, "N 3"]
) -> Float32[np.ndarray, " N"]:
    """Signed distance to the plane [m], positive upwards."""
    return (xyz_m @ plane[:3].astype(np.float32) + np.float32(plane[3])).astype(np.float32)


def _lowest_of_cells(xyz_m: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest point of each cell, and its weight in the fit of the ground under the vehicle."""
    row, top_m = _ends_of_cells(xyz_m, chosen)
    low = xyz_m[row].astype(np.float64)
    # The vehicle stands on the ground that is wanted: cells near it and along its way count more than ditches
    # and banks beside the road; cells with something standing in them, whose lowest point may be a bumper, less.
    weight = 1 / (1 + (low[:, 0] / _TRUSTED_AHEAD_M) ** 2 + (low[:, 1] / _TRUSTED_ASIDE_M) ** 2)
    return low, np.where(top_m - low[:, 2] < _FLAT_M, weight, 0.2 * weight)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _ends_of_cells(xyz: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of the lowest point of each cell, and height of the highest; cells in order of x, then y."""
    lowest = np.full(_GRID_CELLS * _GRID_CELLS, -1)
    top = np.full(len(lowest), -np.inf)
    for i in range(len(xyz)):
        if chosen[i]:
            c, z = _cell(xyz[i, 0], xyz[i, 1]), xyz[i, 2]
            if lowest[c] < 0 or z < xyz[lowest[c], 2]:
                lowest[c] = i
            top[c] = max(top[c], z)
    occupied = np.flatnonzero(lowest >= 0)
    return lowest[occupied], top[occupied]


def _fit_plane(
    low: np.ndarray, weight: np.ndarray, inlier_m: float, rng: np.random.Generator
) -> np.ndarray | None:
    """Best of many 3-point planes that could be a road, refined by least squares."""
    if len(low) < _MIN_SUPPORT:
        return None
    picks = rng.choice(len(low), size=(_HYPOTHESES, 3), p=weight / weight.sum())
    a, b, c = low[picks[:, 0]], low[picks[:, 1]], low[picks[:, 2]]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    # Slivers turn noise into tilt: the triangle's area must be that of a car's footprint at least.
    wide = length > 16.0
    normal = np.where(normal[:, 2:] < 0, -normal, normal)[wide] / length[wide, None]
    offset = -np.sum(normal * a[wide], axis=1)
    possible = (
        (normal[:, 2] > np.cos(_MAX_TILT_RAD)) & (offset > _HEIGHT_RANGE_M[0]) & (offset < _HEIGHT_RANGE_M[1])
    )
    if not possible.any():
        return None
    normal, offset = normal[possible], offset[possible]
    best = int(np.argmax(_support(low, weight, normal, offset, inlier_m)))
    return _refine(low, weight, np.append(normal[best], offset[best]), inlier_m)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _support(
    low: np.ndarray, weight: np.ndarray, normal: np.ndarray, offset: np.ndarray, inlier_m: float
) -> np.ndarray:
    """Weight of the points in each plane, less half of that of points under it.

    The ground is the lowest surface: points below rule out a plane (through bonnets or hedges).
    """
    score = np.zeros(len(normal))
    for h in range(len(normal)):
        a, b, c, d = normal[h, 0], normal[h, 1], normal[h, 2], offset[h]
        for i in range(len(low)):
            height = a * low[i, 0] + b * low[i, 1] + c * low[i, 2] + d
            inside = 1.0 if abs(height) < inlier_m else 0.0
            under = 0.5 if height < -2 * inlier_m else 0.0
            score[h] += (inside - under) * weight[i]
    return score


def _refine(low: np.ndarray, weight: np.ndarray, plane: np.ndarray, inlier_m: float) -> np.ndarray | None:
    """Weighted least squares on the plane's inliers, repeated with the inliers that it then has."""
    before = np.zeros(len(low), bool)
    for _ in range(8):
        inside = np.abs(low @ plane[:3] + plane[3]) < inlier_m
        if np.count_nonzero(inside) < _MIN_SUPPORT:
            return None
        if np.array_equal(inside, before):  # and so would be all that follows
            break
        before = inside
        points, share = low[inside], weight[inside, None] / weight[inside].sum()
        centre = np.sum(share * points, axis=0)
        normal = np.linalg.svd(np.sqrt(share) * (points - centre), full_matrices=False)[2][2]
        normal = normal if normal[2] > 0 else -normal
        plane = np.append(normal, -normal @ centre)
    return plane if plane[2] > np.cos(_MAX_TILT_RAD) else None


def _follow_surface(
    azimuth: np.ndarray, range_m: np.ndarray, height_m: np.ndarray, inlier_m: float, may_be_ground: np.ndarray
) -> np.ndarray:
    """Height over the local ground: each sector follows possible ground outwards."""
    sector = np.minimum(((azimuth + np.pi) / (2 * np.pi) * _SECTORS).astype(np.int32), _SECTORS - 1)
    bins = int(np.ceil(_FAR_M / _BIN_M)) + 1
    ring = np.minimum((range_m / _BIN_M).astype(np.int32), bins - 1)
    cell = sector * bins + ring
    height, start = _by_cell(height_m.astype(np.float64), cell, may_be_ground, _SECTORS * bins)
    surface = _walk(height, start, _SECTORS, bins, inlier_m)
    # Neighbouring sectors see the same road: their median drops the sector that climbed onto a car.
    surface = np.sort(np.stack([np.roll(surface, s, axis=0) for s in (-2, -1, 0, 1, 2)], axis=-1))[..., 2]
    return (height_m - surface.ravel()[cell]).astype(np.float32)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _by_cell(
    value: np.ndarray, cell: np.ndarray, chosen: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Chosen values cell by cell, and where each cell begins."""
    start = np.zeros(cells + 1, np.int64)
    for i in range(len(value)):
        if chosen[i]:
            start[cell[i] + 1] += 1
    start = np.cumsum(start)
    found, place = np.empty(start[-1]), start[:-1].copy()
    for i in range(len(value)):
        if chosen[i]:
            found[place[cell[i]]] = value[i]
            place[cell[i]] += 1
    return found, start


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _walk(height: np.ndarray, start: np.ndarray, sectors: int, bins: int, inlier_m: float) -> np.ndarray:
    surface, fits = np.zeros((sectors, bins)), np.empty(len(height))
    for s in range(sectors):
        level, gap = 0.0, 1
        for b in range(bins):
            reach = inlier_m + _SLOPE * _BIN_M * min(gap, 4)
            # Upwards half as much: behind a gap without ground, a bonnet is more frequent than a hill.
            count = 0
            for i in range(start[s * bins + b], start[s * bins + b + 1]):
                if height[i] - level > -reach and height[i] - level < (inlier_m + reach) / 2:
                    fits[count] = height[i]
                    count += 1
            if count >= 2:
                # The lower part: the upper one may be the foot of an object.
                level, gap = kth_smallest(fits, count, int(0.3 * (count - 1))), 1
            else:
                gap += 1
            surface[s, b] = level
    return surface


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _second_nearest(direction: np.ndarray, range_m: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Second shortest range per direction (one return may be snow), infinity if there is none."""
    first, second = np.full(_FREE_BINS, np.inf), np.full(_FREE_BINS, np.inf)
    for i in range(len(direction)):
        if chosen[i]:
            d, r = direction[i], range_m[i]
            if r < first[d]:
                first[d], second[d] = r, first[d]
            elif r < second[d]:
                second[d] = r
    return second


@no_type_check
@numba.njit(cache=True)
def _on_grid(xyz: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Mean of the chosen points of each occupied cell."""
    total, count = np.zeros((_GRID_CELLS * _GRID_CELLS, 3)), np.zeros(_GRID_CELLS * _GRID_CELLS, np.int64)
    for i in range(len(xyz)):
        if chosen[i]:
            c = _cell(xyz[i, 0], xyz[i, 1])
            count[c] += 1
            for k in range(3):
                total[c, k] += xyz[i, k]
    occupied = np.flatnonzero(count)
    mean = np.empty((len(occupied), 3), np.float32)
    for j, c in enumerate(occupied):
        mean[j] = total[c] / count[c]
    return mean


@no_type_check
@numba.njit(cache=True)
def _cell(x: float, y: float) -> int:
    """Number of the cell of a point that is seen; it grows with x, then with y."""
    return (int(np.floor(x / _CELL_M)) + _GRID_CELLS // 2) * _GRID_CELLS + (
        int(np.floor(y / _CELL_M)) + _GRID_CELLS // 2
    )


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def kth_smallest(value: np.ndarray, count: int, k: int) -> float:
    """Value number k (from 0) in order of size among the first `count`, whose order changes.

    Source: Hoare 1961, "Algorithm 65: find".
    """
    low, high = 0, count - 1
    while low < high:
        pivot = value[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while value[i] < pivot:
                i += 1
            while pivot < value[j]:
                j -= 1
            if i <= j:
                value[i], value[j] = value[j], value[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return value[k]


@no_type_check
@numba.njit(cache=True)
def median_of(value: np.ndarray, count: int) -> float:
    """Median of the first `count` values, whose order changes; of an even number the mean of the middle two."""
    upper = kth_smallest(value, count, count // 2)
    if count % 2 == 1:
        return upper
    # What lies before the upper middle is not larger.
    lower = value[0]
    for i in range(1, count // 2):
        lower = max(lower, value[i])
    return (lower + upper) / 2
