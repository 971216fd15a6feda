"""Exposure times of image rows, and the camera's pose at those times."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Float64

from pipeline.simulate.world.drives import Motion

__all__ = ["RollingShutter"]

# Brightness changes slowly: rows of a band are lit at one time (in 30 ms / 12 oncoming cars move by some cm).
_BANDS: Final = 12


@dataclass(frozen=True, eq=False)
class RollingShutter:
    """Rows are exposed from top to bottom during `readout_s`, the middle of the image at the frame's time."""

    ego: Motion
    T_vehicle_camera: np.ndarray
    readout_s: float

    def delays_s(self, rows: int) -> Float64[np.ndarray, " H"]:
        """Times of an image's rows after the frame's."""
        return ((np.arange(rows) + 0.5) / rows - 0.5) * self.readout_s

    def poses(self, t_s: float, rows: int) -> Float64[np.ndarray, "H 4 4"]:
        """T_map_camera of each row of an image taken at `t_s` of the drive."""
        return np.asarray(self.ego.poses(t_s + self.delays_s(rows)) @ self.T_vehicle_camera)

    def bands(self, rows: int) -> list[slice]:
        """Bands of rows lit at one time."""
        edges = np.linspace(0, rows, _BANDS + 1).round().astype(int).tolist()
        return [slice(a, b) for a, b in pairwise(edges) if b > a]
