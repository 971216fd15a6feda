"""The radar's drivable area by a small network, in place of the geometric one.

Its manifest, as `boresight train-radar-drivable` writes it, names the model and the grid that it was trained on.

Source: paper, section 4.2 (a weakly supervised network segments the radar's drivable area).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from pipeline.config import FleetConfig
from pipeline.errors import ModelError, ModelOutputError
from pipeline.geometry.radar_grid import CHANNELS, SHAPE, Scan, ScanMemory, grid_layout, sector_of
from pipeline.perceive.drivable import FreeSector
from pipeline.perceive.models.manifest import check_hash, read_manifest
from pipeline.perceive.models.session import AlikeCheck, open_session
from pipeline.rigs import OnnxDrivable

__all__ = ["RadarDrivable"]


class _Manifest(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    path: str
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    task: Literal["radar_drivable"]
    grid: dict[str, Any]
    file: Path = Path()


class RadarDrivable:
    """A model behind its manifest, and the scans of the day so far: one object per vehicle-day."""

    def __init__(self, manifest_file: Path) -> None:
        """Load manifest and model.

        Raises:
            ModelError: missing, wrong, made for another grid, or not the model that the hash says.
        """
        manifest = read_manifest(manifest_file, _Manifest)
        model = manifest_file.parent / manifest.path
        check_hash(manifest_file, model, manifest.sha256)
        for key, value in grid_layout().items():
            if manifest.grid.get(key) != value:
                told = (
                    f"grid.{key}: the model was made for {manifest.grid.get(key)}, this version has {value}"
                )
                raise ModelError(str(manifest_file), told)
        self._file, self._session = str(manifest_file), open_session(model, manifest_file)
        shapes = [i.shape for i in self._session.get_inputs()]
        if shapes != [[1, len(CHANNELS), *SHAPE]]:
            raise ModelError(self._file, f"path: the model's inputs are {shapes}, not the grid's")
        self._memory, self._check_alike = ScanMemory(), AlikeCheck(manifest_file)
        self.provenance: dict[str, Any] = {"radar_drivable": manifest.sha256}

    @classmethod
    def load(cls, wanted: OnnxDrivable, fleet: FleetConfig) -> RadarDrivable:
        """The model that fleet.toml names; its path is relative to it.

        Raises:
            ModelError: see the constructor.
        """
        return cls(fleet.path_of(wanted.model))

    def probability(self, scan: Scan) -> Float[np.ndarray, "A R"]:
        """How likely each cell is drivable; the scan is remembered for those that follow.

        Raises:
            ModelError: the model does not run, or answers with another grid.
        """
        features = self._memory.features(scan)[None]
        try:
            answer = self._session.run(None, {self._session.get_inputs()[0].name: features})[0]
        except Exception as err:  # onnxruntime's own exceptions share no base but this
            raise ModelError(self._file, f"the model failed to run: {err}") from err
        if answer.shape != (1, *SHAPE) or not np.isfinite(answer).all():
            raise ModelOutputError(
                self._file, f"the model gives {list(answer.shape)}, not {[1, *SHAPE]} finite numbers"
            )
        self._check_alike(features, answer)
        return np.asarray(answer[0], np.float32)

    def free_sector(self, scan: Scan) -> FreeSector:
        """Free ranges by direction; scans come in the order of their stamps.

        Raises:
            ModelError: see `probability`.
        """
        return FreeSector(*sector_of(self.probability(scan)))
