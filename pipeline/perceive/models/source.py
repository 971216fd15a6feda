"""Semantics that are computed here: one segmenter and one detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ModelError
from pipeline.core.rigs import OnnxSemantics
from pipeline.perceive.camera import CameraSemantics, FrameRejectedError, decode_colour, label_size
from pipeline.perceive.models.detector import Detector
from pipeline.perceive.models.manifest import Manifest, load_manifest
from pipeline.perceive.models.segmenter import Segmenter
from pipeline.rig.rig import Rig
from schemas.captures import ImageColumns

__all__ = ["ModelSource", "check_models"]


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
