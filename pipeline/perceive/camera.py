"""Camera semantics: a Cityscapes label image and road users, from logged topics or ONNX models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, no_type_check, runtime_checkable

import cv2
import numba
import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.core.config import PerceiveConfig
from pipeline.core.rigs import RoadUser, TopicSemantics
from pipeline.perceive.labels import ROAD_ID, SKY_ID, road_user_name, to_cityscapes
from schemas.captures import ImageColumns

__all__ = [
    "BatchedSource", "CameraSemantics", "Detections", "FrameReason", "FrameRejectedError", "SemanticsSource",
    "TopicSource", "decode_colour", "decode_grey", "encode_png", "label_size", "resize_labels",
]  # fmt: skip

_FLAT_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE,
)  # fmt: skip


class FrameReason(StrEnum):
    """Reasons against a frame; the value is the key of the counts."""

    UNDECODABLE_IMAGE = "image_undecodable"
    IMAGE_SIZE = "image_size_differs_from_camera_info"
    CAMERA_MODEL = "camera_model_invalid"
    NO_LABELS = "labels_missing"
    UNDECODABLE_LABELS = "labels_undecodable"
    LABELS_SHAPE = "labels_aspect_differs_from_image"
    NO_DETECTIONS = "detections_missing"
    BAD_DETECTIONS = "detections_invalid"
    FEW_LIDAR_POINTS = "lidar_points_too_few"
    FEW_RADAR_POINTS = "radar_points_too_few"


class FrameRejectedError(Exception):
    """One frame cannot be used, for `reason`; handled within the stage."""

    def __init__(self, reason: FrameReason) -> None:
        self.reason = reason
        super().__init__(reason.value)


@dataclass(frozen=True, eq=False)
class Detections:
    """Road users in the image: boxes x0 y0 x1 y1 in full-image pixels, names of ROAD_USERS, scores 0..1."""

    boxes_px: Float32[np.ndarray, "N 4"]
    classes: list[str]
    scores: Float32[np.ndarray, " N"]

    def at_least(self, min_score: float) -> Detections:
        """Detections with at least this score."""
        keep = np.flatnonzero(self.scores >= min_score)
        return Detections(self.boxes_px[keep], [self.classes[i] for i in keep], self.scores[keep])


@dataclass(frozen=True, eq=False)
class CameraSemantics:
    """One image's semantics; `labels` are Cityscapes train ids at label size."""

    labels: UInt8[np.ndarray, "H W"]
    detections: Detections

    @property
    def sky_fraction(self) -> float:
        """Share of the image labelled sky."""
        return float(np.count_nonzero(self.labels == SKY_ID) / self.labels.size)

    @property
    def drivable_fraction(self) -> float:
        """Share of the image labelled road."""
        return float(np.count_nonzero(self.labels == ROAD_ID) / self.labels.size)


@runtime_checkable
class SemanticsSource(Protocol):
    """Where semantics come from."""

    def read(self, frame: ImageColumns) -> CameraSemantics:
        """Semantics of one frame; raises FrameRejectedError if there are none."""
        ...


@runtime_checkable
class BatchedSource(SemanticsSource, Protocol):
    """A source of semantics that processes several images at once, on an execution provider of ONNX Runtime."""

    provider: str

    def look_ahead(self, frames: Sequence[ImageColumns]) -> None:
        """Prepare the next calls of `read`."""
        ...


class TopicSource:
    """Semantics from logged topics."""

    def __init__(self, topics: TopicSemantics, config: PerceiveConfig) -> None:
        self._table = to_cityscapes(topics.label_set)
        self._classes = topics.classes
        self._config = config

    def read(self, frame: ImageColumns) -> CameraSemantics:
        """Logged labels in Cityscapes ids at label size, and logged road users above the minimum score.

        Raises:
            FrameRejectedError: labels or detections missing, undecodable, or of another shape than the image.
        """
        if frame.labels_png is None:
            raise FrameRejectedError(FrameReason.NO_LABELS)
        labels = _decode(frame.labels_png, cv2.IMREAD_UNCHANGED)
        if labels is None or labels.ndim != 2 or labels.dtype != np.uint8:
            raise FrameRejectedError(FrameReason.UNDECODABLE_LABELS)
        size = label_size(frame.image_width_px, frame.image_height_px, self._config.label_scale)
        if not _same_aspect(labels.shape, size):
            raise FrameRejectedError(FrameReason.LABELS_SHAPE)
        detections = _logged_detections(frame, self._classes).at_least(self._config.detection_min_score)
        return CameraSemantics(resize_labels(cv2.LUT(labels, self._table), size), detections)


def label_size(width_px: int, height_px: int, scale: float) -> tuple[int, int]:
    """(rows, columns) of label images of an image; the same rounding as `Camera.scaled`."""
    return max(1, round(height_px * scale)), max(1, round(width_px * scale))


def resize_labels(labels: UInt8[np.ndarray, "H W"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Label image at another size (rows, columns); pixel centres stay aligned, so no boundary shifts.

    Reducing by two takes the majority of each 2x2 block, with ties to the smaller id: of four equally near
    pixels, always taking the same one would shift every boundary by half a pixel.
    """
    rows, columns = size
    if labels.shape == (rows, columns):
        return labels
    if labels.shape == (2 * rows, 2 * columns):
        return _majority_of_blocks(labels)
    # INTER_NEAREST rounds down (a shift of up to half a pixel); NEAREST_EXACT samples at the pixel centre.
    return cv2.resize(labels, (columns, rows), interpolation=cv2.INTER_NEAREST_EXACT).astype(
        np.uint8, copy=False
    )


def decode_colour(frame: ImageColumns) -> UInt8[np.ndarray, "H W 3"]:
    """The frame's image as BGR; raises FrameRejectedError if undecodable or of another size."""
    return _sized(_decode(frame.image, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION), frame, 1.0)


def decode_grey(frame: ImageColumns, scale: float) -> UInt8[np.ndarray, "h w"]:
    """The frame's image as grey at label size, JPEG reduced if possible; errors as `decode_colour`."""
    half = scale <= 0.5 and frame.image_format == "jpeg"  # only JPEG saves time by it
    flag = cv2.IMREAD_REDUCED_GRAYSCALE_2 if half else cv2.IMREAD_GRAYSCALE
    grey = _sized(_decode(frame.image, flag | cv2.IMREAD_IGNORE_ORIENTATION), frame, 0.5 if half else 1.0)
    rows, columns = label_size(frame.image_width_px, frame.image_height_px, scale)
    if grey.shape == (rows, columns):
        return grey
    return cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def encode_png(image: UInt8[np.ndarray, "H W"]) -> bytes:
    """PNG mono8, lossless: runs of equal pixels compress label images; filters cost time and gain nothing."""
    ok, blob = cv2.imencode(".png", image, _FLAT_PNG)
    assert ok, "OpenCV cannot encode a grey PNG"
    return bytes(blob)


def _decode(blob: bytes, flag: int) -> np.ndarray | None:
    if not blob:
        return None
    try:
        return cv2.imdecode(np.frombuffer(blob, np.uint8), flag)
    except cv2.error:
        return None


def _sized(image: np.ndarray | None, frame: ImageColumns, scale: float) -> np.ndarray:
    if image is None:
        raise FrameRejectedError(FrameReason.UNDECODABLE_IMAGE)
    # JPEG's reduced decoding rounds odd sizes up.
    wanted = (np.ceil(frame.image_height_px * scale), np.ceil(frame.image_width_px * scale))
    if image.shape[:2] != wanted:
        raise FrameRejectedError(FrameReason.IMAGE_SIZE)
    return image


def _same_aspect(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    """True if aspect ratios are equal up to rounding to whole pixels; False for a crop or another camera."""
    scale_rows, scale_columns = shape[0] / size[0], shape[1] / size[1]
    return abs(scale_rows - scale_columns) <= max(1 / size[0], 1 / size[1]) * max(scale_rows, scale_columns)


def _logged_detections(frame: ImageColumns, own_classes: Mapping[str, RoadUser]) -> Detections:
    boxes, classes, scores = frame.detection_boxes_px, frame.detection_classes, frame.detection_scores
    if boxes is None or classes is None or scores is None:
        raise FrameRejectedError(FrameReason.NO_DETECTIONS)
    if not len(boxes) == len(classes) == len(scores):
        raise FrameRejectedError(FrameReason.BAD_DETECTIONS)
    names = [own_classes.get(c) or road_user_name(c) for c in classes]
    finite = np.isfinite(boxes).all(axis=1) & np.isfinite(scores)
    whole = finite & (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    keep = [i for i, name in enumerate(names) if name is not None and whole[i]]
    return Detections(
        boxes[keep].astype(np.float32),
        [n for n in (names[i] for i in keep) if n],
        scores[keep].astype(np.float32),
    )


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _majority_of_blocks(labels: np.ndarray) -> np.ndarray:
    """The most frequent label of each 2x2 pixels; the smallest of equally frequent ones."""
    out = np.empty((labels.shape[0] // 2, labels.shape[1] // 2), np.uint8)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            p, q = labels[2 * i, 2 * j], labels[2 * i, 2 * j + 1]
            r, s = labels[2 * i + 1, 2 * j], labels[2 * i + 1, 2 * j + 1]
            # In order a <= b <= c <= d: a label held twice or more is a (a = b), else b (b = c), else c (c = d),
            # else all differ.
            low, high, left, right = min(p, q), max(p, q), min(r, s), max(r, s)
            a, d = min(low, left), max(high, right)
            b, c = max(low, left), min(high, right)
            b, c = min(b, c), max(b, c)
            out[i, j] = b if b == c and a != b else (c if c == d and a != b else a)
    return out
