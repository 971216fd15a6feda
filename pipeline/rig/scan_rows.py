"""Neighbouring beams of a lidar sweep in rows; detects sweeps without rows.

A scanner measures in rows: the log has the row of each point (`ring`), or elevations cluster around one value
per row. If the beams of a row are staggered, elevations do not cluster; but clouds are often stored turn by turn. A
lidar with rotating prisms draws a rosette: drivers number its lasers, which readers treat as rings. But
points of one laser that are neighbours in azimuth differ by degrees in elevation. As rows they would make
false depth jumps on the ground.
"""

from __future__ import annotations

from typing import Final, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, Int32, UInt16
from numba import njit

__all__ = ["ScanRows", "rows_of"]

# Elevation changes little from beam to beam in a row: rows of automotive scanners are calibrated to
# hundredths of a degree, de-skewing bends them by less than a tenth, and a sagging raster changes by degrees
# over its whole width only. In one laser of a rosette it changes by degrees.
_SAME_ROW_RAD: Final = np.radians(0.15)
# Gaps between clusters of elevations are wide compared to the clusters; jitter in real beams is below 0.02
# deg.
_BETWEEN_ROWS_RAD: Final = np.radians(0.03)
_FEWEST_IN_ROW: Final = 16
# Minimum share of steps in one sense of rotation, for a cloud stored turn by turn; firings of several lasers
# alternate.
_ONE_SENSE: Final = 0.999
_BESIDE: Final = 6  # points on each side whose mean elevations are compared


class ScanRows(NamedTuple):
    """Row of each point, from the lowest row up, and the points' order by row, then by azimuth."""

    row: Int32[np.ndarray, " N"]
    order: Int[np.ndarray, " N"]


def rows_of(
    azimuth_elevation_range: Float[np.ndarray, "N 3"], ring: UInt16[np.ndarray, " N"] | None
) -> ScanRows | None:
    """Rows of a sweep; None if it has none.

    Args:
        azimuth_elevation_range: of each point [rad, rad, m].
        ring: beam, channel or line of each point in the log; None = not logged, points in stored order.
    """
    if not len(azimuth_elevation_range):
        return None
    azimuth, elevation, _ = azimuth_elevation_range.T
    told = (_by_height(ring, elevation),) if ring is not None else ()
    for row in told or (_by_order(azimuth, elevation), _by_elevation(elevation)):
        if row is not None:
            # NumPy's fast sort, then rows apart: a stable one by two keys takes ten times as long.
            order = _row_by_row(np.argsort(azimuth), azimuth, row, int(row.max()) + 1)
            if _are_rows(elevation[order], row[order]):
                return ScanRows(row, order)
    return None


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _row_by_row(by_azimuth: np.ndarray, azimuth: np.ndarray, row: np.ndarray, rows: int) -> np.ndarray:
    """The points in order of row, then azimuth, then place."""
    place = np.zeros(rows + 1, np.int64)
    for i in range(len(row)):
        place[row[i] + 1] += 1
    place = np.cumsum(place)
    start, order = place.copy(), np.empty(len(row), np.int64)
    for i in by_azimuth:
        k = place[row[i]]
        # Points at the same azimuth came in any order.
        while k > start[row[i]] and azimuth[order[k - 1]] == azimuth[i] and order[k - 1] > i:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
        place[row[i]] += 1
    return order


def _by_height(ring: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Ring numbers renumbered from the lowest beam up (drivers number beams in firing order)."""
    count = np.bincount(ring)
    rings = np.flatnonzero(count)
    mean = np.bincount(ring, elevation)[rings] / count[rings]
    rank = np.empty(len(count), np.int32)
    rank[rings[np.argsort(mean, kind="stable")]] = np.arange(len(rings), dtype=np.int32)
    return rank[ring]


def _by_elevation(elevation: np.ndarray) -> np.ndarray | None:
    """Rows from clusters of elevations; None if the clusters are too small."""
    order = np.argsort(elevation, kind="stable")
    wide = np.diff(elevation[order]) > _BETWEEN_ROWS_RAD
    if len(elevation) < _FEWEST_IN_ROW * (1 + np.count_nonzero(wide)):
        return None
    row = np.empty(len(elevation), np.int32)
    row[order] = np.concatenate([[0], np.cumsum(wide)])
    return row


def _by_order(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray | None:
    """Rows from turns stored one after the other; None if points are not stored so."""
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    sense = np.sign(np.median(step)) if len(step) else 0.0
    way = np.append(0.0, np.cumsum(sense * step)) / (2 * np.pi)
    turns = int(way[-1])
    if sense == 0 or turns < 2 or np.mean(sense * step >= 0) < _ONE_SENSE:
        return None
    return _by_height(np.floor(way + 1.0 - _beginning(way, elevation)).astype(np.uint16), elevation)


def _beginning(way: np.ndarray, elevation: np.ndarray) -> float:
    """Start of the turns, as fraction of a turn: the elevation steps there from row to row.

    It is between the last and the first point, which are close together if turns are complete.
    """
    place = np.arange(1.0, way[-1] % 1.0, -1 / 720)
    crossing = np.searchsorted(way, place + np.arange(int(way[-1]))[:, None])
    total = np.append(0.0, np.cumsum(elevation))
    first, last = np.maximum(crossing - _BESIDE, 0), np.minimum(crossing + _BESIDE, len(way))
    before = (total[crossing] - total[first]) / np.maximum(crossing - first, 1)
    after = (total[last] - total[crossing]) / np.maximum(last - crossing, 1)
    return float(place[np.argmax(np.abs(np.median(after - before, axis=0)))])


def _are_rows(elevation: np.ndarray, row: np.ndarray) -> bool:
    """True if neighbours in a row, in order, have the same elevation; rows of a single point are ignored."""
    step = np.abs(np.diff(elevation))[np.diff(row) == 0]
    return len(step) == 0 or bool(np.median(step) < _SAME_ROW_RAD)
