"""Neighbouring beams of a lidar sweep in rows; sweeps without rows; sweeps as range images.

A scanner measures in rows: the log has the row of each point (`ring`), or elevations cluster around one value
per row. If the beams of a row are staggered, elevations do not cluster; but clouds are often stored turn by turn. A
lidar with rotating prisms draws a rosette: drivers number its lasers, which readers treat as rings. But
points of one laser that are neighbours in azimuth differ by degrees in elevation. As rows they would make
false depth jumps on the ground.

Range images of sweeps follow RangeNet++ (Milioto et al., IROS 2019, sections III-A and III-D; the paper's reference
67): azimuth runs from left behind (column 0) over ahead (the middle) to right behind, rows from the upper edge of the
field of view down; if several points share a pixel, the nearest is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt16
from numba import njit

__all__ = ["EMPTY", "RangeImage", "ScanRows", "channels_of", "project", "rows_of", "vote_of_neighbours"]

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


EMPTY = -1  # range and point index of an empty pixel
_POINTS_AT_ONCE = 16384  # 5 x 5 neighbours each: some 10 MB


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Ranges [m] and drawn points by pixel; pixel and range of each point, drawn or hidden.

    Points outside the field of view have a pixel of its border and are not `inside`.
    """

    range_m: Float32[np.ndarray, "H W"]
    point: Int[np.ndarray, "H W"]
    row: Int[np.ndarray, " N"]
    column: Int[np.ndarray, " N"]
    point_range_m: Float32[np.ndarray, " N"]
    inside: Bool[np.ndarray, " N"]


def project(
    xyz_m: Float32[np.ndarray, "N 3"], size: tuple[int, int], fov_up_deg: float, fov_down_deg: float
) -> RangeImage:
    """Spherical projection of a sweep of finite points (lidar frame: x forward, y left, z up).

    `size` is rows and columns; columns cover 360 deg. Edges of the field of view are elevations above the
    horizon.
    """
    rows, columns = size
    points = xyz_m.astype(np.float64)
    range_m = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(range_m, 1e-9), -1, 1))
    up, down = np.deg2rad(fov_up_deg), np.deg2rad(fov_down_deg)
    height = (up - elevation) / (up - down) * rows
    row = np.clip(np.floor(height), 0, rows - 1).astype(np.int64)
    column = np.clip(np.floor(0.5 * (1 - azimuth / np.pi) * columns), 0, columns - 1).astype(np.int64)
    # Edge rows include beams up to half a row outside; more would collect all outer beams of a lidar there.
    inside = (height >= -0.5) & (height < rows + 0.5) & (range_m > 0)
    image = np.full(size, EMPTY, np.float32)
    point = np.full(size, EMPTY, np.int64)
    drawn = np.flatnonzero(inside)
    drawn = drawn[np.argsort(-range_m[drawn], kind="stable")]  # numpy keeps the last of repeated pixels
    image[row[drawn], column[drawn]] = range_m[drawn]
    point[row[drawn], column[drawn]] = drawn
    return RangeImage(image, point, row, column, range_m.astype(np.float32), inside)


def channels_of(
    image: RangeImage, xyz_m: Float32[np.ndarray, "N 3"], remission: Float32[np.ndarray, " N"]
) -> Float32[np.ndarray, "5 H W"]:
    """Range, x, y, z [m] and remission by pixel; EMPTY in all five for empty pixels."""
    values = np.column_stack([image.point_range_m, xyz_m, remission]).astype(np.float32)
    channels = np.full((5, *image.point.shape), EMPTY, np.float32)
    filled = image.point != EMPTY
    channels[:, filled] = values[image.point[filled]].T
    return channels


def vote_of_neighbours(
    image: RangeImage, labels: Int[np.ndarray, "H W"], classes: int, *, neighbours: int, search: int,
    sigma_px: float, cutoff_m: float,
) -> Int[np.ndarray, " N"]:  # fmt: skip
    """Labels of all points, by vote of the surrounding pixels closest in range.

    A hidden point has the label of the drawn point in its own pixel, but its neighbours in range outvote it.
    Azimuth wraps around. Label 0, unlabelled, wins only without other votes.

    Args:
        neighbours: maximum number of voting pixels.
        search: side of the square search window [px], odd.
        sigma_px: sigma of the Gaussian that weights range differences by pixel distance.
        cutoff_m: pixels with a larger range difference have no vote.
    """
    half = search // 2
    ranges = np.where(image.range_m == EMPTY, np.float32(np.inf), image.range_m)
    framed_range = _framed(ranges, half, np.inf)
    framed_label = _framed(labels, half, 0.0)
    dy, dx = (offset.ravel() for offset in np.mgrid[0:search, 0:search])
    far = _farness(search, sigma_px)
    result = np.zeros(len(image.row), np.int64)
    rows = np.flatnonzero(image.inside)
    for first in range(0, len(rows), _POINTS_AT_ONCE):
        part = rows[first : first + _POINTS_AT_ONCE]
        y, x = image.row[part, None] + dy, image.column[part, None] + dx
        distance = np.abs(framed_range[y, x] - image.point_range_m[part, None]) * far
        distance[:, len(far) // 2] = 0  # its own pixel, even if another point is drawn there
        nearest = np.argpartition(distance, neighbours - 1, axis=1)[:, :neighbours]
        label = np.take_along_axis(framed_label[y, x], nearest, axis=1)
        label[np.take_along_axis(distance, nearest, axis=1) > cutoff_m] = 0
        votes = np.zeros((len(part), classes), np.int64)
        np.add.at(votes, (np.arange(len(part))[:, None], label), 1)
        votes[:, 0] = 0
        result[part] = np.argmax(votes, axis=1)
    return result


def _farness(search: int, sigma_px: float) -> Float[np.ndarray, " K"]:
    """One minus the normalised Gaussian of the window's pixels: factor of range differences."""
    offset = np.arange(search) - search // 2
    gauss = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * sigma_px**2))
    return (1 - gauss / gauss.sum()).astype(np.float32).ravel()


def _framed(image: np.ndarray, half: int, outside: float) -> np.ndarray:
    """The image with margins: columns wrap around, `outside` above and below."""
    wrapped = np.pad(image, ((0, 0), (half, half)), mode="wrap")
    return np.pad(wrapped, ((half, half), (0, 0)), constant_values=outside)
