"""Image maps of the camera-lidar terms: offsets to boundaries by direction, road contrast, labels.

All maps are at label size. Boundaries lie between pixels, so an offset is stored as the integer k of k + 1/2
pixels from a pixel's centre along the boundary's axis: exact in one byte, for every kernel width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Int8, UInt8

from pipeline.rig.cameras import Camera, camera_of
from schemas.observations import STEP_BELOW, STEP_RIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from schemas.observations import Observation

__all__ = [
    "CONTRAST_STEP", "NO_BOUNDARY", "CameraMaps", "Start", "boundary_offsets", "contrast_levels",
    "free_ground", "prepare_maps", "step_offsets",
]  # fmt: skip

NO_BOUNDARY = -128  # no boundary of this direction within REACH_PX
REACH_PX = 96
_NONE = 10_000  # no boundary yet: beyond any image
CONTRAST_STEP = 1 / 32  # of a standard deviation: one byte reaches +-4
_MIN_ROAD_PX_IN_ROW = 12
_ROAD = 0
# How near to the camera a label's surfaces lie against a neighbouring label's: a boundary's foreground is the nearer
# side. Sky is behind all, ground behind what stands on it, walls and plants behind poles and road users.
_SKY, _GROUND, _BACKDROP, _OBJECT = 0, 1, 2, 3
_UNKNOWN = 255
_DEPTH_ORDER = np.full(256, _UNKNOWN, np.uint8)
_DEPTH_ORDER[[10]] = _SKY
_DEPTH_ORDER[[0, 1, 9]] = _GROUND
_DEPTH_ORDER[[2, 3, 4, 8]] = _BACKDROP
_DEPTH_ORDER[[5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18]] = _OBJECT
_COLUMN_PX = 8.0


@dataclass(frozen=True, eq=False)
class Start:
    """A pose that the day's frames are projected with before the right one is known, and its sigma."""

    T_camera_lidar: np.ndarray
    sigma_rad: float


@dataclass(frozen=True, eq=False)
class CameraMaps:
    """Maps of F frames at label size H x W, and the camera that projects into them."""

    camera: Camera  # scaled to label size
    offsets: np.ndarray  # int8, F 4 H W: by EDGE_*, k of k + 1/2 px along u (left, right) or v (above, below)
    # int8, L F H W: road contrast in CONTRAST_STEP standard deviations of its row, 0 outside
    contrast: np.ndarray
    labels: np.ndarray  # uint8, F H W


def _foreground_table() -> UInt8[np.ndarray, "256 256"]:
    """Nearer side of a boundary between labels a (left or above) and b: bit 0 is a, bit 1 is b.

    Both for two objects; none for two backdrops, two kinds of ground, or unknown labels.
    """
    a, b = _DEPTH_ORDER[:, None].astype(np.int64), _DEPTH_ORDER[None].astype(np.int64)
    objects = (a == b) & (a == _OBJECT)
    known = (a != _UNKNOWN) & (b != _UNKNOWN) & ~np.eye(256, dtype=bool)
    return ((known & (objects | (a > b))) + 2 * (known & (objects | (b > a)))).astype(np.uint8)


_FOREGROUND = _foreground_table()


def boundary_offsets(
    labels: UInt8[np.ndarray, "H W"], out: Int8[np.ndarray, "4 H W"] | None = None
) -> Int8[np.ndarray, "4 H W"]:
    """Offsets to boundaries by direction class: at pixel + offset + 1/2, or NO_BOUNDARY out of reach."""
    out = np.empty((4, *labels.shape), np.int8) if out is None else out
    _fill_rows(_FOREGROUND, labels, _borders(labels), out[:2])
    labels = cv2.transpose(labels)  # columns become rows: memory is read and written in its order
    turned = np.empty((2, *labels.shape), np.int8)
    _fill_rows(_FOREGROUND, labels, _borders(labels), turned)
    for side in range(2):
        cv2.transpose(turned[side], out[2 + side])
    return out


def _borders(labels: np.ndarray) -> np.ndarray:
    """Flat indices of pixels whose right neighbour has another label; NumPy compares 64 at once."""
    differs = np.zeros(labels.shape, bool)
    np.not_equal(labels[:, :-1], labels[:, 1:], out=differs[:, :-1])
    return np.flatnonzero(differs)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _fill_rows(foreground: np.ndarray, labels: np.ndarray, borders: np.ndarray, out: np.ndarray) -> None:
    """Fill out[2, H, W] with offsets along the rows, for every stretch between two boundaries of a class."""
    height, width = labels.shape
    for side in range(2):
        at = 0
        for i in range(height):
            row, begin, behind = out[side, i], 0, -_NONE
            while at < borders.shape[0] and borders[at] < (i + 1) * width:
                j = borders[at] - i * width
                at += 1
                if foreground[labels[i, j], labels[i, j + 1]] & (1 << side):
                    _fill(row, begin, j + 1, behind, j)
                    begin, behind = j + 1, j
            _fill(row, begin, width, behind, _NONE)


@no_type_check
@numba.njit(cache=True, nogil=True, inline="always")
def _fill(row: np.ndarray, begin: int, end: int, behind: int, ahead: int) -> None:
    """Offsets of a stretch: to the boundary behind it up to the middle, then to the one ahead, where in reach."""
    middle = min(max(min((ahead + behind + 1) // 2, behind + REACH_PX) + 1, begin), end)
    near = min(max(ahead - REACH_PX, middle), end)
    for k in range(begin, middle):
        row[k] = behind - k
    for k in range(middle, near):
        row[k] = NO_BOUNDARY
    for k in range(near, end):
        row[k] = ahead - k


def contrast_levels(
    contrast: UInt8[np.ndarray, "H W"], is_road: Bool[np.ndarray, "H W"], blurs_px: tuple[float, ...]
) -> Int8[np.ndarray, "L H W"]:
    """Blurred road contrast, int8 [L, H, W]: zero mean and unit spread along each row of the road, 0 outside.

    Normalised by row, because contrast grows towards the horizon and would attract every point there.
    """
    out = np.zeros((len(blurs_px), *contrast.shape), np.int8)
    rows = np.flatnonzero(is_road.sum(1) >= _MIN_ROAD_PX_IN_ROW)
    if rows.size < 10:
        return out
    band = slice(rows[0], rows[-1] + 1)
    inside = is_road[band].astype(np.float32)
    value = contrast[band].astype(np.float32) * inside
    count = np.maximum(_over_rows(inside.sum(1, keepdims=True)), 1.0)
    smooth = np.empty_like(value)
    sums = np.empty((2, len(value), 1), np.float32)
    for level, blur in enumerate(blurs_px):
        _mean_over_road(inside, _blurred(value, blur), _blurred(inside, blur), smooth, sums)
        mean, square = (_over_rows(s) / count for s in sums)
        # One grey level of spread: below it a road is plain, and its noise must not be blown up to unit size.
        spread = np.sqrt(np.maximum(square - mean * mean, 0.0)) + 1.0
        _standardise(inside, smooth, mean, spread, out[level, band])
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _mean_over_road(
    inside: np.ndarray, value: np.ndarray, share: np.ndarray, smooth: np.ndarray, sums: np.ndarray
) -> None:
    """Blurred contrast as a mean over the road alone, and the sums over each row of it and of its square."""
    for i in range(inside.shape[0]):
        total, squares = np.float32(0), np.float32(0)
        for j in range(inside.shape[1]):
            x = inside[i, j] * value[i, j] / max(share[i, j], np.float32(0.05))
            smooth[i, j] = x
            total += x
            squares += x * x
        sums[0, i, 0], sums[1, i, 0] = total, squares


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _standardise(
    inside: np.ndarray, smooth: np.ndarray, mean: np.ndarray, spread: np.ndarray, out: np.ndarray
) -> None:
    """Zero mean and unit spread by row in steps of CONTRAST_STEP, 0 outside the road."""
    steps, low, high = np.float32(1 / CONTRAST_STEP), np.float32(-2.0), np.float32(3.9)
    for i in range(inside.shape[0]):
        middle, per_spread = mean[i, 0], np.float32(1) / spread[i, 0]
        for j in range(inside.shape[1]):
            x = inside[i, j] * (smooth[i, j] - middle) * per_spread
            out[i, j] = np.int8(steps * min(max(x, low), high))


def _blurred(x: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian blur, by two box filters if it is wide (their cost does not grow with the width)."""
    if sigma_px < 2.0:
        return cv2.GaussianBlur(x, (2 * round(2.5 * sigma_px) + 1,) * 2, sigma_px)
    size = (round(np.sqrt(6 * sigma_px**2 + 1)) | 1,) * 2  # each box has half of the variance
    return cv2.blur(cv2.blur(x, size), size)


def _over_rows(x: np.ndarray) -> np.ndarray:
    """Gaussian blur along the columns."""
    return cv2.GaussianBlur(x, (1, 25), 0, sigmaY=4.0)


def prepare_maps(
    observations: Sequence[Observation], blurs_px: tuple[float, ...], start: Start
) -> CameraMaps:
    """Decode and prepare the maps of frames that share one camera and one label size.

    Without labels, borders are steps of brightness, and paint is looked for where `start` puts free ground.
    """
    camera = camera_of(observations[0]).scaled(observations[0].label_scale)
    labels = np.stack([_decoded(o.labels_png) for o in observations])
    count, size = len(observations), labels.shape[1:]
    offsets = np.empty((count, 4, *size), np.int8)
    contrast = np.zeros((len(blurs_px), count, *size), np.int8)
    for f, o in enumerate(observations):
        is_road = labels[f] == _ROAD
        if o.steps_png is None:
            boundary_offsets(labels[f], offsets[f])
        else:
            offsets[f] = step_offsets(_decoded(o.steps_png))
            is_road = free_ground(o.lidar_drivable_xyz_m.astype(np.float64), camera, start)
        if o.road_contrast_png is not None:
            contrast[:, f] = contrast_levels(_decoded(o.road_contrast_png), is_road, blurs_px)
    return CameraMaps(camera, offsets, contrast, labels)


def _decoded(png: bytes) -> UInt8[np.ndarray, "H W"]:
    """A mono8 image."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


def step_offsets(steps: UInt8[np.ndarray, "H W"]) -> Int8[np.ndarray, "4 H W"]:
    """As `boundary_offsets`, of steps of brightness: they show no side, so opposite classes have the same offsets."""
    right, below = _along_rows((steps & STEP_RIGHT) > 0), _along_rows((steps.T & STEP_BELOW) > 0).T
    return np.stack([right, right, below, below])


def _along_rows(is_step: Bool[np.ndarray, "H W"]) -> Int8[np.ndarray, "H W"]:
    column = np.arange(is_step.shape[1])
    behind = np.maximum.accumulate(np.where(is_step, column, -_NONE), axis=1)
    behind = np.pad(behind, ((0, 0), (1, 0)), constant_values=-_NONE)[:, :-1] - column
    ahead = np.minimum.accumulate(np.where(is_step, column, _NONE)[:, ::-1], axis=1)[:, ::-1] - column
    nearest = np.where(2 * ahead + 1 < -2 * behind - 1, ahead, behind)
    return np.where(np.abs(nearest) <= REACH_PX, nearest, NO_BOUNDARY).astype(np.int8)


def free_ground(xyz_m: Float[np.ndarray, "N 3"], camera: Camera, start: Start) -> Bool[np.ndarray, "H W"]:
    """Pixels that may show the ground that the lidar finds free; `camera` is at the maps' size.

    From the far end of the free ground in each direction, as the start projects it, down to the picture's lower
    end, and as far around that as one sigma of the start turns it.
    """
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    T = start.T_camera_lidar
    uv, is_seen = camera.project(xyz_m @ T[:3, :3].T + T[:3, 3])
    size = np.array([camera.width_px, camera.height_px])
    uv = np.clip(uv[is_seen], -size, 2 * size)
    columns, of_column = np.unique(uv[:, 0] // _COLUMN_PX, return_inverse=True)
    if len(columns) < 2:
        return mask > 0
    far_end = np.full(len(columns), np.inf)
    np.minimum.at(far_end, of_column.ravel(), uv[:, 1])
    outline = np.column_stack([(columns + 0.5) * _COLUMN_PX, far_end])
    feet = [[outline[-1, 0], camera.height_px], [outline[0, 0], camera.height_px]]
    cv2.fillPoly(mask, [np.round(np.concatenate([outline, feet])).astype(np.int32)], 1)
    reach_px = round(float(camera.K[0, 0]) * start.sigma_rad)
    return np.asarray(cv2.dilate(mask, np.ones((2 * reach_px + 1,) * 2, np.uint8)) > 0)
