"""Sweeps as range images: spherical projection, input channels of a network, point labels from neighbours.

Conventions of RangeNet++: azimuth runs from left behind (column 0) over ahead (the middle) to right behind,
rows from the upper edge of the field of view down; if several points share a pixel, the nearest is drawn.

Source: Milioto et al., RangeNet++ (IROS 2019), sections III-A and III-D; the paper's reference 67.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

__all__ = ["EMPTY", "RangeImage", "channels_of", "project", "vote_of_neighbours"]

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
    image: RangeImage,
    labels: Int[np.ndarray, "H W"],
    classes: int,
    *,
    neighbours: int,
    search: int,
    sigma_px: float,
    cutoff_m: float,
) -> Int[np.ndarray, " N"]:
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
