"""Ground under the vehicle in one lidar sweep: a plane, its points, and the free ground around.

RANSAC uses the lowest point of each cell of a grid over the ground, so that neither the dense rings around
the vehicle nor walls outvote the road. Then each sector follows the surface outwards, because roads bend and
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

__all__ = ["Ground", "PointKind", "PointSource", "find_ground", "height_over"]

_NEAR_M = 2.5  # nearer returns are the vehicle itself
_FAR_M = 60.0  # a 0.2 deg grazing angle and less: no ground returns worth a plane
_CELL_M = 1.0
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
    range_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    seen = (range_m > _NEAR_M) & (range_m < _FAR_M)
    plane = _fit_plane(*_lowest_of_cells(xyz_m[road]), inlier_m, rng)
    if plane is None:  # too little road: what a model calls ground is no object all the same
        return Ground(None, labelled & seen, labelled & road & seen, np.zeros((0, 3), np.float32))
    above_local = _follow_surface(xyz_m, height_over(plane, xyz_m), inlier_m, may_be_ground)
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
    free = _reachable(xyz_m, range_m, blocks)
    return Ground(plane, is_ground, is_road, _on_grid(xyz_m[is_road & free]))


def height_over(
    plane: Float[np.ndarray, " 4"], xyz_m: Float32[np.ndarray, "N 3"]
) -> Float32[np.ndarray, " N"]:
    """Signed distance to the plane [m], positive upwards."""
    return (xyz_m @ plane[:3].astype(np.float32) + np.float32(plane[3])).astype(np.float32)


def _lowest_of_cells(xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest point of each cell, and its weight in the fit of the ground under the vehicle."""
    range_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    near = xyz_m[(range_m > _NEAR_M) & (range_m < _PLANE_REACH_M)].astype(np.float64)
    if not len(near):
        return near, np.zeros(0)
    cell = _cells(near)
    order = np.lexsort((near[:, 2], cell))
    first = np.flatnonzero(np.append(True, np.diff(cell[order]) != 0))
    low = near[order[first]]
    top_m = near[order[np.append(first[1:], len(order)) - 1], 2]
    # The vehicle stands on the ground that is wanted: cells near it and along its way count more than ditches
    # and banks beside the road; cells with something standing in them, whose lowest point may be a bumper, less.
    weight = 1 / (1 + (low[:, 0] / _TRUSTED_AHEAD_M) ** 2 + (low[:, 1] / _TRUSTED_ASIDE_M) ** 2)
    return low, np.where(top_m - low[:, 2] < _FLAT_M, weight, 0.2 * weight)


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
    for _ in range(8):
        inside = np.abs(low @ plane[:3] + plane[3]) < inlier_m
        if np.sum(inside) < _MIN_SUPPORT:
            return None
        points, share = low[inside], weight[inside, None] / weight[inside].sum()
        centre = np.sum(share * points, axis=0)
        normal = np.linalg.svd(np.sqrt(share) * (points - centre), full_matrices=False)[2][2]
        normal = normal if normal[2] > 0 else -normal
        plane = np.append(normal, -normal @ centre)
    return plane if plane[2] > np.cos(_MAX_TILT_RAD) else None


def _follow_surface(
    xyz_m: np.ndarray, height_m: np.ndarray, inlier_m: float, may_be_ground: np.ndarray
) -> np.ndarray:
    """Height over the local ground: each sector follows possible ground outwards."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    sector = np.minimum(((azimuth + np.pi) / (2 * np.pi) * _SECTORS).astype(np.int32), _SECTORS - 1)
    ring = (np.hypot(xyz_m[:, 0], xyz_m[:, 1]) / _BIN_M).astype(np.int32)
    bins = int(np.ceil(_FAR_M / _BIN_M)) + 1
    ring = np.minimum(ring, bins - 1)
    cell = sector * bins + ring
    order = np.argsort(cell, kind="stable")
    order = order[may_be_ground[order]]
    start = np.searchsorted(cell[order], np.arange(_SECTORS * bins + 1))
    surface = _walk(height_m[order].astype(np.float64), start, _SECTORS, bins, inlier_m)
    # Neighbouring sectors see the same road: their median drops the sector that climbed onto a car.
    surface = np.median(np.stack([np.roll(surface, s, axis=0) for s in (-2, -1, 0, 1, 2)]), axis=0)
    return (height_m - surface[sector, ring]).astype(np.float32)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _walk(height: np.ndarray, start: np.ndarray, sectors: int, bins: int, inlier_m: float) -> np.ndarray:
    surface = np.zeros((sectors, bins))
    for s in range(sectors):
        level, gap = 0.0, 1
        for b in range(bins):
            cell = height[start[s * bins + b] : start[s * bins + b + 1]]
            reach = inlier_m + _SLOPE * _BIN_M * min(gap, 4)
            # Upwards half as much: behind a gap without ground, a bonnet is more frequent than a hill.
            fits = np.sort(cell[(cell - level > -reach) & (cell - level < (inlier_m + reach) / 2)])
            if fits.size >= 2:
                # The lower part: the upper one may be the foot of an object.
                level, gap = fits[int(0.3 * (fits.size - 1))], 1
            else:
                gap += 1
            surface[s, b] = level
    return surface


def _reachable(xyz_m: np.ndarray, range_m: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """True where nothing that blocks stands nearer in the same direction; the own vehicle does not."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    direction = np.minimum(((azimuth + np.pi) / (2 * np.pi) * _FREE_BINS).astype(np.int32), _FREE_BINS - 1)
    blocks = blocks & (range_m > _NEAR_M)
    limit = _second_nearest(direction[blocks], range_m[blocks])
    return range_m < limit[direction]


def _second_nearest(direction: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Second shortest range per direction (one return may be snow), infinity if there is none."""
    order = np.lexsort((range_m, direction))
    direction, range_m = direction[order], range_m[order]
    limit = np.full(_FREE_BINS, np.inf)
    second = np.flatnonzero(direction[1:] == direction[:-1]) + 1
    directions, first = np.unique(direction[second], return_index=True)
    limit[directions] = range_m[second[first]]
    return limit


def _on_grid(ground_m: np.ndarray) -> np.ndarray:
    """Mean ground point of each occupied cell."""
    _, index, count = np.unique(_cells(ground_m), return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index, ground_m[:, k], len(count)) for k in range(3)], axis=1)
    return (sums / count[:, None]).astype(np.float32)


def _cells(xyz_m: np.ndarray) -> np.ndarray:
    """Number of each point's cell, which grows with x, then with y."""
    x, y = (np.floor(xyz_m[:, k] / _CELL_M).astype(np.int64) for k in (0, 1))
    return (x << 32) + y
