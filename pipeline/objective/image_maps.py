"""What the camera-lidar terms look up in an image: signed offsets to mask boundaries by direction, road contrast, labels.

All maps are at label size. Boundaries lie between pixels, so an offset is stored as the integer k of k + 1/2 pixels
from a pixel's centre along the boundary's axis: exact in one byte, and good for every kernel width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numba
import numpy as np

from pipeline.geometry.cameras import Camera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from schemas.observations import Observation

__all__ = [
    "CONTRAST_STEP",
    "NO_BOUNDARY",
    "CameraMaps",
    "boundary_offsets",
    "camera_of",
    "contrast_levels",
    "prepare_maps",
]

NO_BOUNDARY = -128  # no boundary of this direction within REACH_PX
REACH_PX = 96
CONTRAST_STEP = 1 / 32  # of a standard deviation: one byte reaches +-4
_MIN_ROAD_PX_IN_ROW = 12
# How near to the camera a label's surfaces lie against a neighbouring label's: a boundary's foreground is the nearer
# side. Sky is behind all, ground behind what stands on it, walls and plants behind poles and road users.
_SKY, _GROUND, _BACKDROP, _OBJECT = 0, 1, 2, 3
_DEPTH_ORDER = np.full(256, 255, np.uint8)
_DEPTH_ORDER[[10]] = _SKY
_DEPTH_ORDER[[0, 1, 9]] = _GROUND
_DEPTH_ORDER[[2, 3, 4, 8]] = _BACKDROP
_DEPTH_ORDER[[5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18]] = _OBJECT


@dataclass(frozen=True, eq=False)
class CameraMaps:
    """Maps of F frames at label size H x W, and the camera that projects into them."""

    camera: Camera  # scaled to label size
    offsets: np.ndarray  # int8, F 4 H W: by EDGE_*, k of k + 1/2 px along u (left, right) or v (above, below)
    contrast: (
        np.ndarray
    )  # int8, L F H W: road contrast in CONTRAST_STEP standard deviations of its row, 0 outside
    labels: np.ndarray  # uint8, F H W


def camera_of(observation: Observation) -> Camera:
    """The camera at full image size."""
    return Camera(
        observation.camera_model,
        np.asarray(observation.camera_K, np.float64),
        np.asarray(observation.camera_D, np.float64),
        observation.image_width_px,
        observation.image_height_px,
    )


@numba.njit(cache=True, nogil=True)
def _scan(order: np.ndarray, labels: np.ndarray, out: np.ndarray) -> None:
    """Fill out[4, H, W] with offsets to the nearest boundary of each direction class along its axis."""
    height, width = labels.shape
    out[:] = -128
    # axis 0: along u, classes LEFT 0 (foreground left) and RIGHT 1; axis 1: along v, ABOVE 2 and BELOW 3
    for axis in range(2):
        lines = height if axis == 0 else width
        length = width if axis == 0 else height
        for line in range(lines):
            for side in range(2):
                last = -10000
                for i in range(length - 1):
                    if axis == 0:
                        a, b = labels[line, i], labels[line, i + 1]
                    else:
                        a, b = labels[i, line], labels[i + 1, line]
                    is_boundary = False
                    if a != b:
                        oa, ob = order[a], order[b]
                        if oa != 255 and ob != 255:
                            # Two backdrops, or two kinds of ground: the labels say nothing of which is nearer.
                            if oa == ob:
                                is_boundary = oa == 3
                            else:
                                is_boundary = (oa > ob) == (side == 0)
                    if is_boundary:
                        first = max(last + 1 if last >= 0 else 0, i - 96)
                        if last >= 0:
                            first = max(first, (last + i) // 2 + 1)
                        for j in range(first, i + 1):
                            if axis == 0:
                                out[side, line, j] = i - j
                            else:
                                out[2 + side, j, line] = i - j
                        for j in range(i + 1, min(length, i + 97)):
                            if axis == 0:
                                out[side, line, j] = i - j
                            else:
                                out[2 + side, j, line] = i - j
                        last = i


def boundary_offsets(labels: np.ndarray) -> np.ndarray:
    """Offsets to boundaries, int8 [4, H, W]; the boundary lies at pixel + offset + 1/2; NO_BOUNDARY where none is in reach."""
    out = np.empty((4, *labels.shape), np.int8)
    _scan(_DEPTH_ORDER, labels, out)
    return out


def contrast_levels(contrast: np.ndarray, is_road: np.ndarray, blurs_px: tuple[float, ...]) -> np.ndarray:
    """Blurred road contrast, int8 [L, H, W]: zero mean and unit spread along each row of the road, 0 outside.

    Normalised by row, because contrast grows towards the horizon and would pull every point there.
    """
    out = np.zeros((len(blurs_px), *contrast.shape), np.int8)
    rows = np.flatnonzero(is_road.sum(1) >= _MIN_ROAD_PX_IN_ROW)
    if rows.size < 10:
        return out
    band = slice(rows[0], rows[-1] + 1)
    inside = is_road[band].astype(np.float32)
    value = contrast[band].astype(np.float32) * inside
    count = np.maximum(_row_sums(inside), 1.0)
    for level, blur in enumerate(blurs_px):
        kernel = (2 * round(2.5 * blur) + 1,) * 2
        weight = cv2.GaussianBlur(inside, kernel, blur)
        smooth = inside * cv2.GaussianBlur(value, kernel, blur) / np.maximum(weight, 0.05)
        mean = _row_sums(smooth) / count
        variance = _row_sums(smooth * smooth) / count - mean * mean
        # One grey level of spread: below it a road is plain, and its noise must not be blown up to unit size.
        standard = inside * (smooth - mean) / (np.sqrt(np.maximum(variance, 0.0)) + 1.0)
        out[level, band] = np.clip(standard, -2.0, 3.9) / CONTRAST_STEP
    return out


def _row_sums(x: np.ndarray) -> np.ndarray:
    """Sums over each row and, with falling weight, the rows about it, as a column."""
    return cv2.GaussianBlur(x.sum(1, keepdims=True), (1, 25), 0, sigmaY=4.0)


def prepare_maps(observations: Sequence[Observation], blurs_px: tuple[float, ...]) -> CameraMaps:
    """Decode and prepare the maps of frames that share one camera and one label size."""
    first = observations[0]
    camera = camera_of(first).scaled(first.label_scale)
    offsets, contrast, labels = [], [], []
    for o in observations:
        label = cv2.imdecode(np.frombuffer(o.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
        labels.append(label)
        offsets.append(boundary_offsets(label))
        if o.road_contrast_png is None:
            contrast.append(np.zeros((len(blurs_px), *label.shape), np.int8))
        else:
            image = cv2.imdecode(np.frombuffer(o.road_contrast_png, np.uint8), cv2.IMREAD_GRAYSCALE)
            contrast.append(contrast_levels(image, label == 0, blurs_px))
    return CameraMaps(camera, np.stack(offsets), np.stack(contrast, 1), np.stack(labels))
