"""Classes of lidar points by a range-image ONNX model in RangeNet++'s convention.

An example of its manifest: `pipeline/perceive/README.md`.
Source: Milioto et al., RangeNet++ (IROS 2019); paper, section 4.2 (RangeNet++ and RANSAC successively).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float32, UInt8
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from pipeline.core.errors import ModelOutputError
from pipeline.perceive.ground import PointKind
from pipeline.perceive.models.manifest import ModelFile, Section, read_manifest
from pipeline.perceive.models.session import Session
from pipeline.rig.scan_rows import EMPTY, channels_of, project, vote_of_neighbours

__all__ = ["POINT_LABEL_SETS", "RangeImageManifest", "RangeImageSegmenter"]

_ROAD, _FLAT, _USER, _OTHER = PointKind.ROAD, PointKind.FLAT, PointKind.ROAD_USER, PointKind.OTHER
# Labels in the order of the networks' classes, as semantic-kitti.yaml's learning_map_inv has them.
POINT_LABEL_SETS: dict[str, dict[str, PointKind]] = {
    "semantickitti": {
        "unlabeled": PointKind.UNKNOWN,
        "car": _USER, "bicycle": _USER, "motorcycle": _USER, "truck": _USER, "other-vehicle": _USER,
        "person": _USER, "bicyclist": _USER, "motorcyclist": _USER,
        "road": _ROAD, "parking": _ROAD, "sidewalk": _FLAT, "other-ground": _FLAT,
        "building": _OTHER, "fence": _OTHER, "vegetation": _OTHER, "trunk": _OTHER,
        "terrain": _FLAT, "pole": _OTHER, "traffic-sign": _OTHER,
    },
}  # fmt: skip


class _Input(Section):
    size: tuple[PositiveInt, PositiveInt]
    fov_up_deg: Annotated[float, Field(ge=-90, le=90)]
    fov_down_deg: Annotated[float, Field(ge=-90, le=90)]
    mean: tuple[float, float, float, float, float]
    std: tuple[PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat]
    empty: Literal["zero", "minus_one"] = "zero"

    @model_validator(mode="after")
    def _sees_something(self) -> _Input:
        if self.fov_up_deg <= self.fov_down_deg:
            raise ValueError("fov_up_deg must be above fov_down_deg (which is negative below the horizon)")
        return self


class _Output(Section):
    layout: Literal["logits"]
    label_set: Literal["semantickitti"]  # keys of POINT_LABEL_SETS


class _Knn(Section):
    neighbours: PositiveInt = 5
    search: PositiveInt = 5
    sigma_px: PositiveFloat = 1.0
    cutoff_m: PositiveFloat = 1.0

    @model_validator(mode="after")
    def _window_has_a_centre_and_enough_pixels(self) -> _Knn:
        if self.search % 2 == 0:
            raise ValueError("search must be odd: the window has the point's pixel in its middle")
        if self.neighbours > self.search**2:
            raise ValueError(f"neighbours = {self.neighbours}, but the window has {self.search**2} pixels")
        return self


class RangeImageManifest(ModelFile):
    """One model for range images."""

    task: Literal["segment_points"]
    input: _Input
    output: _Output
    knn: _Knn = _Knn()

    @model_validator(mode="after")
    def _window_fits(self) -> RangeImageManifest:
        if self.knn.search > min(self.input.size):
            raise ValueError(f"knn.search = {self.knn.search} is more than input.size has")
        return self


class RangeImageSegmenter:
    """A model with its manifest; sweeps are independent of each other."""

    def __init__(self, manifest_file: Path, remission_scale: float = 1.0) -> None:
        """Load manifest and model; raises ModelError if missing or of another hash.

        `remission_scale` maps logged intensity to that of the training data (0..1 for SemanticKITTI).
        """
        manifest = read_manifest(manifest_file, RangeImageManifest)
        self._manifest, self._file, self._scale = manifest, str(manifest_file), remission_scale
        self._session = Session(manifest, (5, *manifest.input.size))
        self._kinds = np.array(list(POINT_LABEL_SETS[manifest.output.label_set].values()), np.uint8)
        told = manifest.model_dump(mode="json", exclude={"file", "path"})
        self.provenance: dict[str, Any] = {"lidar_segmenter": told | {"remission_scale": remission_scale}}

    def kinds(
        self, xyz_m: Float32[np.ndarray, "N 3"], intensity: Float32[np.ndarray, " N"] | None
    ) -> UInt8[np.ndarray, " N"]:
        """The PointKind of each point of a sweep; unknown outside the model's field of view.

        Without logged intensity, the input is the mean of the training data.

        Raises:
            ModelError: the model does not run, or its output has another shape than the manifest's.
        """
        spec, knn = self._manifest.input, self._manifest.knn
        image = project(xyz_m, spec.size, spec.fov_up_deg, spec.fov_down_deg)
        channels = channels_of(image, xyz_m, self._remission(len(xyz_m), intensity))
        logits = self._run(self._normalised(channels, image.point != EMPTY))
        labels = vote_of_neighbours(
            image, np.argmax(logits, axis=0), len(self._kinds), neighbours=knn.neighbours, search=knn.search,
            sigma_px=knn.sigma_px, cutoff_m=knn.cutoff_m,
        )  # fmt: skip
        return self._kinds[labels]

    def _remission(self, points: int, intensity: np.ndarray | None) -> np.ndarray:
        mean = np.full(points, self._manifest.input.mean[4], np.float32)
        if intensity is None:
            return mean
        scaled = intensity.astype(np.float32) * np.float32(self._scale)
        return np.where(np.isfinite(scaled), scaled, mean)

    def _normalised(self, channels: np.ndarray, filled: np.ndarray) -> np.ndarray:
        spec = self._manifest.input
        mean, std = (np.array(v, np.float32)[:, None, None] for v in (spec.mean, spec.std))
        normal = (channels - mean) / std
        if spec.empty == "zero":
            normal[:, ~filled] = 0
        return np.ascontiguousarray(normal[None], np.float32)

    def _run(self, tensor: np.ndarray) -> np.ndarray:
        """Logits CxHxW."""
        answer = self._session.run(tensor)
        wanted = [1, len(self._kinds), *self._manifest.input.size]
        if list(answer.shape) != wanted:
            raise ModelOutputError(
                self._file,
                f"output.layout: logits must be {wanted} (1, labels of {self._manifest.output.label_set}, "
                f"rows, columns), the model gives {list(answer.shape)}",
            )
        return np.asarray(answer[0], np.float32)
