"""The radar's drivable area by a small network, in place of the geometric one.

`boresight train --task radar_drivable` writes its manifest, which names the model and its grid.

Source: paper, section 4.2 (a weakly supervised network segments the radar's drivable area).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ModelError, ModelOutputError
from pipeline.perceive.drivable import FreeSector
from pipeline.perceive.models.manifest import ModelFile, read_manifest
from pipeline.perceive.models.session import Session
from pipeline.rig.radar_grid import CHANNELS, SHAPE, Scan, ScanMemory, grid_layout, sector_of

__all__ = ["RadarDrivable"]


class _Manifest(ModelFile):
    task: Literal["radar_drivable"]
    grid: dict[str, Any]


class RadarDrivable:
    """A model behind its manifest, and the scans of the day so far: one object per vehicle-day."""

    def __init__(self, manifest_file: Path) -> None:
        """Load manifest and model; raises ModelError if missing, for another grid, or of another hash."""
        manifest = read_manifest(manifest_file, _Manifest)
        for key, value in grid_layout().items():
            if manifest.grid.get(key) != value:
                told = (
                    f"grid.{key}: the model was made for {manifest.grid.get(key)}, this version has {value}"
                )
                raise ModelError(str(manifest_file), told)
        self._file, self._session = str(manifest_file), Session(manifest, (len(CHANNELS), *SHAPE))
        self._memory = ScanMemory()
        self.provenance: dict[str, Any] = {"radar_drivable": manifest.sha256}

    def probability(self, scan: Scan) -> Float[np.ndarray, "A R"]:
        """Probability that each cell is drivable; the scan is kept for the following ones.

        Raises:
            ModelError: the model does not run, or returns another grid.
        """
        answer = self._session.run(self._memory.features(scan)[None])
        if answer.shape != (1, *SHAPE):
            raise ModelOutputError(self._file, f"the model gives {list(answer.shape)}, not {[1, *SHAPE]}")
        return np.asarray(answer[0], np.float32)

    def free_sector(self, scan: Scan) -> FreeSector:
        """Free ranges by direction, for scans in the order of their stamps; errors as `probability`."""
        return FreeSector(*sector_of(self.probability(scan)))
