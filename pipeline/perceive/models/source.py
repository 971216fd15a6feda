"""Semantics computed here: a segmenter (SegFormer-style logits at reduced resolution, or labels) and a detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.core.rigs import OnnxSemantics
from pipeline.perceive.camera import CameraSemantics, FrameRejectedError, decode_colour, label_size
from pipeline.perceive.labels import LABEL_COUNTS, VOID_ID, to_cityscapes
from pipeline.perceive.models.detector import Detector
from pipeline.perceive.models.manifest import Manifest, load_manifest
from pipeline.perceive.models.session import AlikeCheck, Fit, Session, fit_image
from pipeline.rig.rig import Rig
from schemas.captures import ImageColumns

__all__ = ["ModelSource", "Segmenter", "check_models", "labels_of_logits"]


def check_models(rig: Rig, fleet: FleetConfig) -> None:
    """Check that every model of a rig exists with the hash of its manifest, without running it.

    Raises:
        ModelError: a manifest or model is missing, wrong, or has another hash.
    """
    for camera in rig.cameras.values():
        if isinstance(camera.semantics, OnnxSemantics):
            _manifests(camera.semantics, fleet)


def _manifests(wanted: OnnxSemantics, fleet: FleetConfig) -> tuple[Manifest, Manifest]:
    """Of segmenter and detector, named in fleet.toml relative to it."""
    segmenter = load_manifest(fleet.path_of(wanted.segmenter), "segment")
    return segmenter, load_manifest(fleet.path_of(wanted.detector), "detect")


class ModelSource:
    """Semantics of images from ONNX models."""

    def __init__(self, wanted: OnnxSemantics, fleet: FleetConfig) -> None:
        """Load the models named in fleet.toml; raises ModelError as `check_models`."""
        (segmenter, detector), config = _manifests(wanted, fleet), fleet.perceive
        self._segmenter = Segmenter(segmenter, config.providers)
        self._detector, self._config = Detector(detector, config.providers), config
        self._known: dict[int, CameraSemantics | Exception] = {}
        self.provider = self._segmenter.provider
        self.provenance: dict[str, Any] = {
            "segmenter": segmenter.model_dump(mode="json", exclude={"file", "path"}),
            "detector": detector.model_dump(mode="json", exclude={"file", "path"}),
        }

    def read(self, frame: ImageColumns) -> CameraSemantics:
        """Run both models on the frame's image.

        Raises:
            FrameRejectedError: the image is undecodable or of the wrong size.
            ModelError: a model contradicts its manifest.
        """
        if id(frame) not in self._known:
            self.look_ahead([frame])
        found = self._known.pop(id(frame))
        if isinstance(found, Exception):
            raise found
        return found

    def look_ahead(self, frames: Sequence[ImageColumns]) -> None:
        """Run the models on the next frames together; errors are raised by `read`."""
        self._known, images = {}, {}
        for frame in frames:
            try:
                images[id(frame)] = decode_colour(frame)
            except FrameRejectedError as why:
                self._known[id(frame)] = why
        readable = [frame for frame in frames if id(frame) in images]
        scale = self._config.label_scale
        sizes = [label_size(f.image_width_px, f.image_height_px, scale) for f in readable]
        try:
            found = [self._detector.detect(image) for image in images.values()]
            labels = self._segmenter.segment_each(list(images.values()), sizes)
        except ModelError as err:
            self._known |= dict.fromkeys(images, err)
            return
        least = self._config.detection_min_score
        for frame, own, users in zip(readable, labels, found, strict=True):
            self._known[id(frame)] = CameraSemantics(own, users.at_least(least))


class Segmenter:
    """A segmentation model behind its manifest."""

    def __init__(self, manifest: Manifest, providers: Sequence[str] = ()) -> None:
        self._manifest = manifest
        self._session = Session(manifest, (3, *manifest.input.size), providers)
        self.provider = self._session.provider
        self._table = to_cityscapes(manifest.output.label_set)
        self._check_alike = AlikeCheck(manifest.file)

    def segment_each(
        self, images_bgr: Sequence[UInt8[np.ndarray, "H W 3"]], sizes: Sequence[tuple[int, int]]
    ) -> list[UInt8[np.ndarray, "h w"]]:
        """Cityscapes train ids of images at `sizes` (rows, columns), in one run if the model takes batches.

        Raises:
            ModelOutputError: another shape or classes than the manifest's, not finite, or the same for
                several images.
        """
        fitted = [fit_image(image, self._manifest.input) for image in images_bgr]
        outputs = self._session.run_each([tensor for tensor, _ in fitted])
        return [
            self._labels(image, output, fit, size)
            for image, output, (_, fit), size in zip(images_bgr, outputs, fitted, sizes, strict=True)
        ]

    def _labels(
        self, image_bgr: np.ndarray, output: np.ndarray, fit: Fit, size: tuple[int, int]
    ) -> np.ndarray:
        if self._manifest.output.layout == "labels":
            labels = self._plain_labels(output, fit, size)
        else:
            self._check_classes(output)
            labels = labels_of_logits(output[0], fit, self._manifest.input.size, size)
        self._check_alike(image_bgr[::4, ::4], labels)
        return self._table[labels]

    def _check_classes(self, logits: np.ndarray) -> None:
        """Raise if the number of classes is not the label set's."""
        counts = LABEL_COUNTS[self._manifest.output.label_set]
        if logits.ndim != 4 or logits.shape[0] != 1 or logits.shape[1] not in counts:
            wanted = " or ".join(map(str, counts))
            raise ModelOutputError(
                str(self._manifest.file),
                f"output.layout: logits of {self._manifest.output.label_set} must be 1 x {wanted} x h x w, "
                f"the model gives {list(logits.shape)}",
            )

    def _plain_labels(self, output: np.ndarray, fit: Fit, size: tuple[int, int]) -> np.ndarray:
        is_plane = output.ndim >= 2 and output.size == output.shape[-2] * output.shape[-1]
        most = max(LABEL_COUNTS[self._manifest.output.label_set])
        if not is_plane or output.min() < 0 or np.any((output >= most) & (output != VOID_ID)):
            raise ModelOutputError(
                str(self._manifest.file),
                f"output.layout: labels of {self._manifest.output.label_set} must be one image of 0..{most - 1} or "
                f"{VOID_ID}, the model gives {list(output.shape)}, {output.min():g} to {output.max():g}",
            )
        plane = output.reshape(output.shape[-2:]).astype(np.float32)
        labels = _resample(plane, fit, self._manifest.input.size, size, cv2.INTER_NEAREST)
        return labels.astype(np.uint8)


def labels_of_logits(
    logits: Float[np.ndarray, "C h w"], fit: Fit, input_size: tuple[int, int], size: tuple[int, int]
) -> UInt8[np.ndarray, "H W"]:
    """Most likely class at each label pixel.

    Logits are interpolated bilinearly before the choice, so that boundaries are not steps of the output's
    stride; pixel centres stay aligned, and the padding of a letterbox is left out.
    """
    best = np.full(size, -np.inf, np.float32)
    label = np.zeros(size, np.uint8)
    for c, plane in enumerate(logits):
        value = _resample(np.asarray(plane, np.float32), fit, input_size, size, cv2.INTER_LINEAR)
        better = value > best
        best[better] = value[better]
        label[better] = c
    return label


def _resample(
    plane: np.ndarray, fit: Fit, input_size: tuple[int, int], size: tuple[int, int], interpolation: int
) -> np.ndarray:
    """A plane over the model's whole input, sampled at the centres of label pixels."""
    stride_y, stride_x = input_size[0] / plane.shape[0], input_size[1] / plane.shape[1]
    # Centre of label pixel i: (i + 0.5) label pixels from the edge of the image -> input pixels -> output
    # pixels.
    step_x, step_y = fit.width / size[1] / stride_x, fit.height / size[0] / stride_y
    M = np.array(
        [
            [step_x, 0.0, 0.5 * step_x + fit.offset_x / stride_x - 0.5],
            [0.0, step_y, 0.5 * step_y + fit.offset_y / stride_y - 0.5],
        ]
    )
    return cv2.warpAffine(
        plane,
        M,
        (size[1], size[0]),
        flags=interpolation | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
