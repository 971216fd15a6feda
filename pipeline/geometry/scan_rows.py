"""Which beams of a lidar sweep lie side by side in a row, and whether it has rows at all.

A scanner draws rows, and says which point is of which row (`ring`), or its elevations crowd around one value per row.
Where its beams start side by side they do not crowd, but clouds are often stored one whole turn after the other. A
lidar with turning prisms draws a rosette: its drivers number lasers, which readers take for rings, but neighbours in
azimuth of one laser lie degrees apart in elevation. Calling anything there a row makes jumps of the ground and of time
look like silhouettes.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int32, UInt16

__all__ = ["rows_of"]

# Along a row the elevation hardly changes from beam to beam: rows of cars' scanners are calibrated to hundredths of a
# degree, de-skewing bends them by less than a tenth, and a raster that sags does so by degrees over its whole width.
# Of one laser of a rosette it changes by degrees.
_SAME_ROW_RAD: Final = np.radians(0.15)
# A gap between crowds of elevations is wide against what lies inside them; jitter inside is below 0.02 deg for real
# beams.
_BETWEEN_ROWS_RAD: Final = np.radians(0.03)
_FEWEST_IN_ROW: Final = 16
# Of steps from point to point of a cloud that is stored turn by turn, those that go on in one sense; firings of several
# lasers go to and fro.
_ONE_SENSE: Final = 0.999
_BESIDE: Final = 6  # points to each side of a place, whose mean elevations are compared


def rows_of(
    azimuth_elevation_range: Float[np.ndarray, "N 3"], ring: UInt16[np.ndarray, " N"] | None
) -> Int32[np.ndarray, " N"] | None:
    """Row numbers from the lowest row up; None where the sweep has no rows.

    Args:
        azimuth_elevation_range: of each point [rad, rad, m].
        ring: what the log calls the point's beam, channel or line; None = it does not say, and points are as stored.
    """
    if not len(azimuth_elevation_range):
        return None
    azimuth, elevation, _ = azimuth_elevation_range.T
    told = (_by_height(ring, elevation),) if ring is not None else ()
    for row in told or (_by_order(azimuth, elevation), _by_elevation(elevation)):
        if row is not None and _are_rows(azimuth, elevation, row):
            return row
    return None


def _by_height(ring: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Ring numbers renumbered from the lowest beam up (drivers number beams in firing order)."""
    rings, inverse = np.unique(ring, return_inverse=True)
    mean = np.bincount(inverse, elevation) / np.bincount(inverse)
    rank = np.empty(len(rings), np.int32)
    rank[np.argsort(mean, kind="stable")] = np.arange(len(rings), dtype=np.int32)
    return rank[inverse]


def _by_elevation(elevation: np.ndarray) -> np.ndarray | None:
    """Crowds of elevations; None where they are too small to be rows."""
    order = np.argsort(elevation, kind="stable")
    wide = np.diff(elevation[order]) > _BETWEEN_ROWS_RAD
    if len(elevation) < _FEWEST_IN_ROW * (1 + np.count_nonzero(wide)):
        return None
    row = np.empty(len(elevation), np.int32)
    row[order] = np.concatenate([[0], np.cumsum(wide)])
    return row


def _by_order(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray | None:
    """Turns, one stored after the other; None where the points are not stored so."""
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    sense = np.sign(np.median(step)) if len(step) else 0.0
    way = np.append(0.0, np.cumsum(sense * step)) / (2 * np.pi)
    turns = int(way[-1])
    if sense == 0 or turns < 2 or np.mean(sense * step >= 0) < _ONE_SENSE:
        return None
    return _by_height(np.floor(way + 1.0 - _beginning(way, elevation)).astype(np.uint16), elevation)


def _beginning(way: np.ndarray, elevation: np.ndarray) -> float:
    """Where turns begin, in parts of one: there the elevation steps from row to row.

    Not before the last point nor after the first one, and there is little between if they are whole.
    """
    place = np.arange(1.0, way[-1] % 1.0, -1 / 720)
    crossing = np.searchsorted(way, place + np.arange(int(way[-1]))[:, None])
    total = np.append(0.0, np.cumsum(elevation))
    first, last = np.maximum(crossing - _BESIDE, 0), np.minimum(crossing + _BESIDE, len(way))
    before = (total[crossing] - total[first]) / np.maximum(crossing - first, 1)
    after = (total[last] - total[crossing]) / np.maximum(last - crossing, 1)
    return float(place[np.argmax(np.abs(np.median(after - before, axis=0)))])


def _are_rows(azimuth: np.ndarray, elevation: np.ndarray, row: np.ndarray) -> bool:
    """Whether neighbours in a row lie at one height; a row of a single point says nothing."""
    order = np.lexsort((azimuth, row))
    step = np.abs(np.diff(elevation[order]))[np.diff(row[order]) == 0]
    return len(step) == 0 or bool(np.median(step) < _SAME_ROW_RAD)
