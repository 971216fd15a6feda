"""Semantics that are computed here: one segmenter and one detector."""

from __future__ import annotations

from typing import Any

from pipeline.config import FleetConfig, PerceiveConfig
from pipeline.perceive.camera import CameraSemantics, decode_colour, label_size
from pipeline.perceive.models.detector import Detector
from pipeline.perceive.models.manifest import Manifest, load_manifest
from pipeline.perceive.models.segmenter import Segmenter
from pipeline.rig.rig import Rig
from pipeline.rigs import OnnxSemantics
from schemas.captures import ImageColumns

__all__ = ["ModelSource", "check_models"]


def check_models(rig: Rig, fleet: FleetConfig) -> None:
    """Make sure that every model that a rig names is there and is the one that its manifest means; nothing is run.

    Raises:
        ModelError: a manifest or model is missing, wrong, or not the one that its hash says.
    """
    for camera in rig.cameras.values():
        if isinstance(camera.semantics, OnnxSemantics):
            load_manifest(fleet.path_of(camera.semantics.segmenter), "segment")
            load_manifest(fleet.path_of(camera.semantics.detector), "detect")


class ModelSource:
    """Semantics of images from ONNX models."""

    def __init__(self, segmenter: Manifest, detector: Manifest, config: PerceiveConfig) -> None:
        self._segmenter, self._detector, self._config = Segmenter(segmenter), Detector(detector), config
        self.provenance: dict[str, Any] = {
            "segmenter": segmenter.model_dump(mode="json", exclude={"file", "path"}),
            "detector": detector.model_dump(mode="json", exclude={"file", "path"}),
        }

    @classmethod
    def load(cls, wanted: OnnxSemantics, fleet: FleetConfig) -> ModelSource:
        """Load the models that fleet.toml names; their paths are relative to it.

        Raises:
            ModelError: a manifest or model is missing, wrong, or not the one that its hash says.
        """
        segmenter = load_manifest(fleet.path_of(wanted.segmenter), "segment")
        detector = load_manifest(fleet.path_of(wanted.detector), "detect")
        return cls(segmenter, detector, fleet.perceive)

    def read(self, frame: ImageColumns) -> CameraSemantics:
        """Run both models on the frame's image.

        Raises:
            FrameRejectedError: the image is undecodable or of the wrong size.
            ModelError: a model does not do what its manifest says.
        """
        image = decode_colour(frame)
        size = label_size(frame.image_width_px, frame.image_height_px, self._config.label_scale)
        found = self._detector.detect(image).at_least(self._config.detection_min_score)
        return CameraSemantics(self._segmenter.segment(image, size), found)
