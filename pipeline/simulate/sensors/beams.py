"""Directions and times of a lidar's beams: rows of a scanner, or the rosette of two rotating prisms.

Source of the rosette: Marshall 1999, "Risley prism scan patterns" (SPIE 3787): each prism adds a rotating
deflection, and their sum is periodic only if the ratio of their rates is one of small whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64, UInt16

from pipeline.simulate.sensors.data_sheets import LidarSpec

__all__ = ["Beams", "beams_of"]


@dataclass(frozen=True, eq=False)
class Beams:
    """All beams of a sweep in order of firing: (azimuth, elevation) [rad], laser, firing."""

    angles: Float64[np.ndarray, "N 2"]
    laser: UInt16[np.ndarray, " N"]
    column: Int64[np.ndarray, " N"]


def beams_of(spec: LidarSpec, end_s: float) -> Beams:
    """The beams of the sweep that ends at `end_s`; a scanner has the same in every sweep."""
    return _scanned(spec) if spec.pattern == "rows" else _rosette(spec, end_s)


@lru_cache(maxsize=8)
def _scanned(spec: LidarSpec) -> Beams:
    azimuth = np.radians(np.linspace(spec.azimuth_deg[1], spec.azimuth_deg[0], spec.columns, endpoint=False))
    elevation = np.radians(spec.row_elevation_deg or np.linspace(*spec.elevation_deg, spec.rows))
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    return Beams(np.stack([a.ravel(), e.ravel()], 1), *_numbers(spec))


def _rosette(spec: LidarSpec, end_s: float) -> Beams:
    """An ellipse that fills the field of view; every laser has its own phase."""
    t = end_s + np.linspace(-spec.sweep_s, 0.0, spec.columns)
    phase = np.arange(spec.rows) / spec.rows * 2 * np.pi
    first, second = (
        2 * np.pi * f * t[:, None] + sign * phase for f, sign in zip(spec.prisms_hz, (1, 2), strict=True)
    )
    along, up = (np.cos(first) + np.cos(second)) / 2, (np.sin(first) + np.sin(second)) / 2
    angles = [
        np.radians((low + high) / 2 + (high - low) / 2 * share)
        for (low, high), share in ((spec.azimuth_deg, along), (spec.elevation_deg, up))
    ]
    return Beams(np.stack([a.ravel() for a in angles], 1), *_numbers(spec))


def _numbers(spec: LidarSpec) -> tuple[np.ndarray, np.ndarray]:
    column, laser = np.meshgrid(np.arange(spec.columns), np.arange(spec.rows), indexing="ij")
    return laser.ravel().astype(np.uint16), column.ravel()
