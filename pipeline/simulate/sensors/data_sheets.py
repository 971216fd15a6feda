"""Data sheets of cameras, lidars and radars of the simulated rigs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.rig.cameras import Camera

__all__ = ["CameraSpec", "LidarSpec", "RadarSpec"]


@dataclass(frozen=True)
class CameraSpec:
    """A camera; `equidistant` is f-theta: image radius proportional to the angle from the axis.

    Angles of a pinhole camera are without distortion. The rows of a rolling shutter are exposed from top to
    bottom during `readout_s`; the stamp is that of the middle row.
    """

    width_px: int = 1824
    height_px: int = 940
    horizontal_deg: float = 116.0
    vertical_deg: float = 58.5
    focal_error: float = 0.001  # sd of the true focal length against the logged one
    centre_error_px: float = 0.4  # at full width
    jpeg_quality: int = 88
    model: Literal["equidistant", "plumb_bob"] = "equidistant"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # in ROS order
    readout_s: float = 0.0

    def nominal(self) -> Camera:
        """Intrinsics as logged."""
        half_x, half_y = np.radians(self.horizontal_deg / 2), np.radians(self.vertical_deg / 2)
        if self.model == "plumb_bob":
            half_x, half_y = np.tan(half_x), np.tan(half_y)
        fx, fy = self.width_px / 2 / half_x, self.height_px / 2 / half_y
        K = np.array([[fx, 0, (self.width_px - 1) / 2], [0, fy, (self.height_px - 1) / 2], [0, 0, 1.0]])
        return Camera(self.model, K, np.array(self.distortion), self.width_px, self.height_px)


@dataclass(frozen=True)
class LidarSpec:
    """A scanning lidar; all beams of a column fire together, columns from left to right during `sweep_s`.

    Rows are spaced evenly over `elevation_deg`, or at `row_elevation_deg` if given, the lowest first. In the
    pattern `rosette` the columns are firings of `rows` lasers behind two rotating prisms: no sweep repeats
    another.
    """

    azimuth_deg: tuple[float, float] = (-30.0, 30.0)
    elevation_deg: tuple[float, float] = (-15.0, 9.0)
    columns: int = 240
    rows: int = 96
    sweep_s: float = 0.08
    min_range_m: float = 5.0
    max_range_m: float = 80.0
    range_sigma_m: float = 0.02
    divergence_deg: float = 0.10  # half angle of the footprint
    row_elevation_deg: tuple[float, ...] = ()
    pattern: Literal["rows", "rosette"] = "rows"


@dataclass(frozen=True)
class RadarSpec:
    """An FMCW MIMO radar: resolution cells and accuracy of its estimator.

    `road_mirror` is the share of echoes that also reach the radar by reflection on the road, with an
    elevation between the object and its mirror image (`radar.py`); with 0, the road changes elevations up
    as often as down.
    """

    azimuth_deg: float = 30.0  # half field of view
    elevation_deg: float = 12.0
    min_range_m: float = 5.0
    max_range_m: float = 80.0
    azimuth_resolution_deg: float = 1.6
    elevation_resolution_deg: float = 6.0
    range_resolution_m: float = 0.3
    doppler_resolution_mps: float = 0.15
    doppler_step_mps: float = 0.08
    doppler_period_mps: float | None = 40.0
    doppler_positive: str = "receding"
    has_elevation: bool = True
    rays: int = 9000
    road_mirror: float = 0.0
    elevation_noise: float = 1.0  # factor on the noise of a single target from resolution and signal to noise

    @property
    def cell(self) -> np.ndarray:
        """Resolution in azimuth [rad], elevation [rad] and range [m]."""
        angles = np.radians([self.azimuth_resolution_deg, self.elevation_resolution_deg])
        return np.append(angles, self.range_resolution_m)
