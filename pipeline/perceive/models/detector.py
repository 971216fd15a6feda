"""Road users by ONNX: YOLOX, YOLOv5/v7 and YOLOv8 heads, tiles, suppression within classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.core.rows import join_rows, take_rows
from pipeline.perceive.camera import Detections
from pipeline.perceive.labels import DETECTOR_COUNTS, DETECTOR_SETS
from pipeline.perceive.models.manifest import Manifest
from pipeline.perceive.models.session import Session, fit_image

__all__ = ["Candidates", "Detector", "decode_head", "suppress"]

_EDGE_PX = 2.0  # of the model's input: a box this near to an inner edge of a tile was cut by it


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes x0 y0 x1 y1, scores and class indices before suppression."""

    boxes: Float32[np.ndarray, "N 4"]
    scores: Float32[np.ndarray, " N"]
    classes: Int[np.ndarray, " N"]


class Detector:
    """A detection model behind its manifest."""

    def __init__(self, manifest: Manifest, providers: Sequence[str] = ()) -> None:
        self._manifest = manifest
        self._session = Session(manifest, (3, *manifest.input.size), providers)
        self._names = DETECTOR_SETS[manifest.output.label_set]

    def detect(self, image_bgr: UInt8[np.ndarray, "H W 3"]) -> Detections:
        """Road users in full-image pixels, the best score first.

        Raises:
            ModelError: another shape than the layout's.
            ModelOutputError: other classes than the label set's, not finite, or the same for several images.
        """
        scales = self._manifest.input.tile_scales
        found = [c for scale in scales for c in self._of_scale(image_bgr, scale)]
        joined = join_rows(found or [self._of_tile(image_bgr, 1.0, 0, 0, image_bgr.shape)])
        joined = take_rows(joined, np.isin(joined.classes, list(self._names)))
        kept = take_rows(joined, suppress(joined, self._manifest.output.nms_iou))
        height, width = image_bgr.shape[:2]
        limit = np.array([width, height, width, height], np.float32)
        return Detections(
            np.clip(kept.boxes, 0, limit), [self._names[int(c)] for c in kept.classes], kept.scores
        )

    def _of_scale(self, image_bgr: np.ndarray, scale: float) -> list[Candidates]:
        """Candidates of all tiles of the image at one size."""
        rows, columns = self._manifest.input.size
        height, width = image_bgr.shape[:2]
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        small = cv2.resize(image_bgr, size, interpolation=cv2.INTER_LINEAR)
        overlap = self._manifest.input.tile_overlap
        return [
            self._of_tile(small[y : y + rows, x : x + columns], scale, x, y, small.shape)
            for y in _tile_starts(small.shape[0], rows, overlap)
            for x in _tile_starts(small.shape[1], columns, overlap)
        ]

    def _of_tile(
        self, tile_bgr: np.ndarray, scale: float, x: int, y: int, whole: tuple[int, ...]
    ) -> Candidates:
        """Candidates of one tile in full-image pixels, without those that its inner edges cut."""
        spec, output = self._manifest.input, self._manifest.output
        tensor, fit = fit_image(tile_bgr, spec)
        answer = self._session.run(tensor)
        classes = DETECTOR_COUNTS[output.label_set]
        head = decode_head(
            answer, output.layout, spec.size, output.strides, str(self._manifest.file), classes
        )
        head = take_rows(head, head.scores >= output.min_score)
        offset = np.array([fit.offset_x, fit.offset_y] * 2, np.float32)
        ratio = np.array([fit.scale_x, fit.scale_y] * 2, np.float32)
        boxes = (head.boxes - offset) / ratio
        height, width = tile_bgr.shape[:2]
        cut = (
            ((x > 0) & (boxes[:, 0] < _EDGE_PX))
            | ((y > 0) & (boxes[:, 1] < _EDGE_PX))
            | ((x + width < whole[1]) & (boxes[:, 2] > width - _EDGE_PX))
            | ((y + height < whole[0]) & (boxes[:, 3] > height - _EDGE_PX))
        )
        full = (boxes + np.array([x, y, x, y], np.float32)) / np.float32(scale)
        return take_rows(Candidates(full, head.scores, head.classes), ~cut)


def decode_head(
    output: np.ndarray, layout: str, input_size: tuple[int, int], strides: tuple[int, ...], manifest: str,
    classes: int,
) -> Candidates:  # fmt: skip
    """Boxes in input pixels, with the best class of each.

    Layouts: "yolox" 1 x A x (4+1+C), raw grid offsets and log sizes, objectness and classes already sigmoid;
    "yolov5" (v5, v7) 1 x A x (4+1+C), centre and size in input pixels; "yolov8" 1 x (4+C) x A, the same
    without objectness.

    Raises:
        ModelError: another shape than the layout has.
        ModelOutputError: another number of classes.
    """
    if output.ndim != 3 or output.shape[0] != 1:
        raise ModelError(
            manifest, f"output.layout: {layout} must be 1 x N x M, the model gives {list(output.shape)}"
        )
    rows = np.asarray(output[0].T if layout == "yolov8" else output[0], np.float32)
    first_class = 4 if layout == "yolov8" else 5
    if rows.shape[1] != first_class + classes:
        found = f"{rows.shape[1] - first_class} classes in {list(output.shape)}"
        raise ModelOutputError(manifest, f"output.layout: {layout} has {found}, its label set has {classes}")
    centre, size = rows[:, :2], rows[:, 2:4]
    if layout == "yolox":
        grid, stride = _yolox_grid(input_size, strides)
        if len(grid) != len(rows):
            raise ModelError(
                manifest,
                f"output.strides: {list(strides)} make {len(grid)} cells, the model gives {len(rows)}",
            )
        centre, size = (centre + grid) * stride, np.exp(np.minimum(size, 20.0)) * stride
    likelihood = rows[:, first_class:]
    best = np.argmax(likelihood, axis=1)
    score = np.take_along_axis(likelihood, best[:, None], axis=1)[:, 0]
    if first_class == 5:
        score = score * rows[:, 4]
    return Candidates(np.concatenate([centre - size / 2, centre + size / 2], axis=1), score, best)


def suppress(found: Candidates, max_iou: float) -> Int[np.ndarray, " K"]:
    """Rows that stay after non-maximum suppression within each class, the best score first."""
    order = np.argsort(-found.scores, kind="stable")
    kept: list[int] = []
    for row in order:
        rivals = [k for k in kept if found.classes[k] == found.classes[row]]
        if not rivals or _iou(found.boxes[row], found.boxes[rivals]).max() <= max_iou:
            kept.append(int(row))
    return np.array(kept, np.int64)


def _yolox_grid(input_size: tuple[int, int], strides: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    cells, sizes = [], []
    for stride in strides:
        rows, columns = input_size[0] // stride, input_size[1] // stride
        y, x = np.mgrid[0:rows, 0:columns]
        cells.append(np.stack([x.ravel(), y.ravel()], axis=1))
        sizes.append(np.full((rows * columns, 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(sizes).astype(np.float32)


def _tile_starts(length: int, tile: int, overlap: float) -> list[int]:
    """Starts of tiles that cover `length` evenly and overlap by at least this fraction."""
    if length <= tile:
        return [0]
    count = int(np.ceil((length - tile) / (tile * (1 - overlap)))) + 1
    return [round(s) for s in np.linspace(0, length - tile, count)]


def _iou(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    overlap = np.prod(np.clip(high - low, 0, None), axis=1)
    area = np.prod(box[2:] - box[:2]) + np.prod(others[:, 2:] - others[:, :2], axis=1) - overlap
    return overlap / np.maximum(area, 1e-6)
