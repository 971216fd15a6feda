"""Depth jumps of a lidar cloud: the end of a nearer surface's silhouette, and the side of that surface.

Along a ring the beams are close together, so a jump is a sharp edge (EDGE_LEFT, EDGE_RIGHT). Between rings
it is only an interval with the width of the gap (EDGE_ABOVE, EDGE_BELOW with `gap_rad`): 0.25 deg on one
lidar, 2 deg on another.

Source: the foreground range at mid-beam direction is where the silhouette is expected, because the last
foreground beam lies anywhere between 0 and one beam inside it; jumps as in Levinson, Thrun 2013, "Automatic
online calibration of cameras and lasers".

A sweep without rows (a rosette) has neither: each point is compared with its nearest neighbours to the four
sides. A silhouette is between two neighbours if the nearer one belongs to a standing object and the farther
one does not belong to it. A neighbour counts as left if its vertical distance is at most half of its
horizontal one. All neighbours behind the silhouette determine its side: at a post's left edge, the beam
above may miss the post too, but this is not an upper edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8, UInt16
from numba import njit
from scipy.spatial import cKDTree

from pipeline.core.config import PerceiveConfig
from pipeline.rig.scan_rows import rows_of
from pipeline.rig.se3 import from_spherical, to_spherical
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT

__all__ = ["LidarEdges", "lidar_edges"]

# Neighbours along a ring may be this many nominal steps apart: one missing return between two surfaces
# leaves an edge whose gap says that it is less sharp; more missing returns (glass, dark paint, sky) tell
# nothing of where the surface ends.
_MAX_STEPS = 2.6
# Azimuth difference, in nominal steps, up to which beams of two rings count as one above the other.
_SAME_COLUMN_STEPS = 0.8
# Rings further apart than this are no neighbours (a ring without returns lies between them).
_MAX_ROW_GAP_RAD = np.radians(3.0)
_MIN_RANGE_M = 1.0  # nearer returns are the own vehicle
_NEIGHBOURS: Final = 16  # of a random pattern these reach about 2.3 mean spacings far
# Median distances to the nearest point; beyond, something did not return in between.
_REACH_STEPS: Final = 4.0
_ASIDE: Final = 0.5  # a neighbour to one side lies at most this much of its distance to another
# Axis of (azimuth, elevation) and sign towards the background: azimuth grows to the left, and a foreground that ends
# at its left lies right of its silhouette.
_SIDES: Final = ((EDGE_RIGHT, 0, 1.0), (EDGE_LEFT, 0, -1.0), (EDGE_BELOW, 1, 1.0), (EDGE_ABOVE, 1, -1.0))


class Jumps(NamedTuple):
    """Jumps of one side: expected silhouette (azimuth, elevation, range), and their points."""

    at_aer: Float[np.ndarray, "E 3"]
    side: int
    jump_m: Float[np.ndarray, " E"]
    gap_rad: Float[np.ndarray, " E"]
    foreground: Int[np.ndarray, " E"]


class _Neighbours(NamedTuple):
    """The nearest other points of each point, and (azimuth, elevation) [rad] to them."""

    point: np.ndarray
    offset_rad: np.ndarray
    reachable: np.ndarray


@dataclass(frozen=True, eq=False)
class LidarEdges:
    """Depth jumps, one row each, as in the columns `lidar_edge_*` of table observations; whether the sweep has rows."""

    xyz_m: Float32[np.ndarray, "E 3"]
    side: UInt8[np.ndarray, " E"]
    jump_m: Float32[np.ndarray, " E"]
    gap_rad: Float32[np.ndarray, " E"]
    points: Int32[np.ndarray, " E"]
    has_rows: bool


def lidar_edges(
    xyz_m: Float32[np.ndarray, "N 3"],
    ring: UInt16[np.ndarray, " N"] | None,
    cluster: Int32[np.ndarray, " N"],
    config: PerceiveConfig,
) -> LidarEdges:
    """Find depth jumps between neighbouring beams of a sweep.

    `ring` is the beam number as logged, which need not be a row; without it rows are found from elevations.
    Only points of a `cluster` make edges between rings, because even the ground has jumps there. A jump must
    exceed both `edge_jump_m` and `edge_jump_fraction` of the range.
    """
    aer = to_spherical(xyz_m.astype(np.float64))
    keep = np.flatnonzero(np.isfinite(aer[:, 2]) & (aer[:, 2] > _MIN_RANGE_M))
    if keep.size < 2:
        return _edges([], keep, cluster, has_rows=False)
    aer = aer[keep]
    rows = rows_of(aer, None if ring is None else ring[keep])
    if rows is None:
        found = _between_neighbours(aer, cluster[keep], config)
        return _edges(found, keep, cluster, has_rows=False)
    aer, row, keep = aer[rows.order], rows.row[rows.order], keep[rows.order]
    steps = np.diff(aer[:, 0])[np.diff(row) == 0]
    steps = steps[steps > 1e-5]
    step_rad = (
        float(np.median(steps)) if steps.size else np.radians(0.2)
    )  # missing returns do not widen the median
    along = _along_rings(aer, row, step_rad, config)
    between = _between_rings(aer, row, cluster[keep], step_rad, config)
    return _edges([*along, *between], keep, cluster, has_rows=True)


def _along_rings(aer: np.ndarray, row: np.ndarray, step_rad: float, config: PerceiveConfig) -> list[Jumps]:
    """Jumps between azimuth neighbours; azimuth grows to the left: the earlier point of a pair is the right one."""
    right = np.arange(len(aer) - 1)
    gap = aer[1:, 0] - aer[:-1, 0]
    pair = (np.diff(row) == 0) & (gap <= _MAX_STEPS * step_rad)
    rise = aer[1:, 2] - aer[:-1, 2]
    nearer_range = np.minimum(aer[1:, 2], aer[:-1, 2])
    is_jump = pair & (np.abs(rise) > np.maximum(config.edge_jump_m, config.edge_jump_fraction * nearer_range))
    # A beam that hits both surfaces returns a point between them: two jumps of the same sense in a
    # row. The nearer one is the silhouette, so the jump whose foreground is itself a background goes.
    towards_right = is_jump & (rise > 0)  # foreground right
    towards_left = is_jump & (rise < 0)
    second_right = towards_right & np.concatenate([[False], towards_right[:-1]])
    second_left = towards_left & np.concatenate([towards_left[1:], [False]])
    found = []
    for side, mask, foreground in (
        (EDGE_RIGHT, towards_right & ~second_right, right),
        (EDGE_LEFT, towards_left & ~second_left, right + 1),
    ):
        i, f = right[mask], foreground[mask]
        middle = (aer[i, :2] + aer[i + 1, :2]) / 2
        found.append(Jumps(np.column_stack([middle, aer[f, 2]]), side, np.abs(rise[i]), gap[i], f))
    return found


def _between_rings(
    aer: np.ndarray, row: np.ndarray, cluster: np.ndarray, step_rad: float, config: PerceiveConfig
) -> list[Jumps]:
    """Jumps between a clustered point and the beam of the next ring above or below it."""
    start = np.searchsorted(row, np.arange(row.max() + 2))
    found = []
    # The foreground lies below the points of the ring above it.
    for side, up in ((EDGE_BELOW, 1), (EDGE_ABOVE, -1)):
        here, there = _jumps_to_row(
            aer, row, cluster, start, up, _SAME_COLUMN_STEPS * step_rad, config.edge_jump_m,
            config.edge_jump_fraction,
        )  # fmt: skip
        at = np.column_stack([aer[here, 0], (aer[here, 1] + aer[there, 1]) / 2, aer[here, 2]])
        gap = np.abs(aer[there, 1] - aer[here, 1])
        found.append(Jumps(at, side, aer[there, 2] - aer[here, 2], gap, here))
    return found


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _jumps_to_row(
    aer: np.ndarray, row: np.ndarray, cluster: np.ndarray, start: np.ndarray, up: int, column_rad: float,
    jump_m: float, jump_fraction: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Clustered points, by row and azimuth, and the points behind them in the same direction, `up` rows further."""
    here, there = np.empty(len(row), np.int64), np.empty(len(row), np.int64)
    count, rows = 0, len(start) - 1
    after, before_row = 0, -1
    for i in range(len(row)):
        other = int(row[i]) + up
        if cluster[i] < 0 or other < 0 or other >= rows or start[other] == start[other + 1]:
            continue
        if row[i] != before_row:
            after, before_row = start[other], row[i]
        end = start[other + 1]
        while after < end and aer[after, 0] < aer[i, 0]:
            after += 1
        left, right = max(after - 1, start[other]), min(after, end - 1)
        j = left if aer[i, 0] - aer[left, 0] <= aer[right, 0] - aer[i, 0] else right
        if (
            abs(aer[j, 0] - aer[i, 0]) <= column_rad
            and abs(aer[j, 1] - aer[i, 1]) <= _MAX_ROW_GAP_RAD
            and aer[j, 2] - aer[i, 2] > max(jump_m, jump_fraction * aer[i, 2])
            and cluster[j] != cluster[i]
        ):
            here[count], there[count] = i, j
            count += 1
    return here[:count], there[:count]


def _edges(found: list[Jumps], keep: np.ndarray, cluster: np.ndarray, *, has_rows: bool) -> LidarEdges:
    """Stack the edges of the points `keep`; `points` counts the foreground's cluster."""
    found = found or [Jumps(np.empty((0, 3)), EDGE_LEFT, np.empty(0), np.empty(0), np.empty(0, np.int64))]
    own = cluster[keep[np.concatenate([f.foreground for f in found])]]
    sizes = np.bincount(cluster[cluster >= 0]) if (cluster >= 0).any() else np.ones(1, np.int64)
    return LidarEdges(
        xyz_m=from_spherical(np.concatenate([f.at_aer for f in found])).astype(np.float32),
        side=np.concatenate([np.full(len(f.jump_m), f.side, np.uint8) for f in found]),
        jump_m=np.concatenate([f.jump_m for f in found]).astype(np.float32),
        gap_rad=np.concatenate([f.gap_rad for f in found]).astype(np.float32),
        points=np.where(own >= 0, sizes[np.maximum(own, 0)], 1).astype(np.int32),
        has_rows=has_rows,
    )


def _between_neighbours(aer: np.ndarray, cluster: np.ndarray, config: PerceiveConfig) -> list[Jumps]:
    """Jumps from clustered points to neighbours that are not of their cluster.

    Unclustered points make no edges: neighbours differ in elevation, so even the ground has jumps.
    """
    if len(aer) <= _NEIGHBOURS:
        return []
    near = _neighbours(aer[:, :2])
    range_m = aer[:, 2]
    least = np.maximum(config.edge_jump_m, config.edge_jump_fraction * range_m)
    is_behind = (range_m[near.point] - range_m[:, None] > least[:, None]) & (
        cluster[near.point] != cluster[:, None]
    )
    # Sum of the directions to them: towards the background, across the silhouette.
    distance = np.maximum(np.linalg.norm(near.offset_rad, axis=-1, keepdims=True), 1e-9)
    towards = np.sum(near.offset_rad / distance * (is_behind & near.reachable)[..., None], axis=1)
    found = []
    for side, axis, sign in _SIDES:
        there, seen = _nearest_to(near, axis, sign)
        before, opposite = _nearest_to(near, axis, -sign)
        faces = sign * towards[:, axis] > np.abs(towards[:, 1 - axis])
        jump = range_m[there] - range_m
        is_edge = seen & faces & (cluster >= 0) & (cluster[there] != cluster) & (jump > least)
        # A beam that hits two surfaces returns a point between them: in front of it the silhouette comes earlier.
        is_edge &= ~(opposite & (range_m - range_m[before] > least[before]))
        here = np.flatnonzero(is_edge)
        middle = (aer[here, :2] + aer[there[here], :2]) / 2
        gap = np.abs(aer[there[here], axis] - aer[here, axis])
        found.append(Jumps(np.column_stack([middle, range_m[here]]), side, jump[here], gap, here))
    return found


def _neighbours(directions: Float[np.ndarray, "N 2"]) -> _Neighbours:
    distance, index = cKDTree(directions).query(directions, k=_NEIGHBOURS + 1)
    distance, index = distance[:, 1:], index[:, 1:]
    step = float(np.median(distance[:, 0]))
    return _Neighbours(index, directions[index] - directions[:, None], distance < _REACH_STEPS * step)


def _nearest_to(
    near: _Neighbours, axis: int, sign: float
) -> tuple[Int[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """The neighbour to one side of each point, and whether it has one."""
    along, aside = sign * near.offset_rad[..., axis], np.abs(near.offset_rad[..., 1 - axis])
    fits = near.reachable & (along > 0) & (aside <= _ASIDE * along)
    nearest = np.argmin(np.where(fits, along, np.inf), axis=1)
    rows = np.arange(len(along))
    return near.point[rows, nearest], fits[rows, nearest]
