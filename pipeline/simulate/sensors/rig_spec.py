"""Data sheets of sensors; specification of a rig: its sensors, nominal poses, deviations of cars from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind

__all__ = ["CameraSpec", "LidarSpec", "RadarSpec", "RigSpec", "SensorSpec", "Sheet", "Triple"]


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


Triple = tuple[float, float, float]
Sheet = CameraSpec | LidarSpec | RadarSpec


@dataclass(frozen=True)
class SensorSpec:
    """One sensor: data sheet, nominal pose in the vehicle frame (rear axle, on the ground), clock.

    Args:
        rpy_deg: rotation about the vehicle's axes: roll first, then pitch (positive = nose down), then yaw
            (to the left).
        delay_s: its stamp of an event minus the reference lidar's.
        rate_hz: rate of a free-running sensor; None = triggered by the reference lidar.
    """

    name: str
    sheet: Sheet
    xyz_m: Triple
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    rate_hz: float | None = None

    @property
    def kind(self) -> Kind:
        """camera, lidar or radar."""
        if isinstance(self.sheet, CameraSpec):
            return "camera"
        return "lidar" if isinstance(self.sheet, LidarSpec) else "radar"


@dataclass(frozen=True)
class RigSpec:
    """Sensors of a model of car, and deviations of its cars from the drawings.

    Args:
        sensors: cameras, lidars and radars; the first lidar is the reference, whose sweeps define the
            moments; without lidars the first radar.
        image_pairs: cameras have another image some metres before each moment, at their own rate.
        delay_sd_s: standard deviation (sd) per vehicle of each delay.
        sync_jitter_s: sd of the stamps of triggered sensors.
        prior_rotation_deg: sd per vehicle and sensor of the mounting against CAD, angle.
        prior_translation_m: sd per axis; fleet.toml states `stated_translation_m`.
        stamp_sigma_s: of its cameras' stamps, as fleet.toml states it.
        remount_rotation_deg: sd per day and axis.
        remount_translation_m: sd per day and axis.
        behind_m: extent of the world behind the vehicle.
    """

    name: str
    sensors: tuple[SensorSpec, ...]
    delay_sd_s: float = 0.004
    sync_jitter_s: float = 0.0012
    prior_rotation_deg: float = 1.2
    prior_translation_m: float = 0.02
    stated_translation_m: float = 0.03
    stamp_sigma_s: float | None = None
    remount_rotation_deg: float = 0.02
    remount_translation_m: float = 0.002
    behind_m: float = 60.0
    image_pairs: bool = False

    def __getitem__(self, name: str) -> SensorSpec:
        """The sensor with this name; raises KeyError if there is none."""
        return {s.name: s for s in self.sensors}[name]

    def of_kind(self, kind: Kind) -> tuple[SensorSpec, ...]:
        """Sensors of a kind, in the rig's order."""
        return tuple(s for s in self.sensors if s.kind == kind)

    @property
    def reference(self) -> SensorSpec:
        """The first lidar; without lidars the first radar."""
        return (*self.of_kind("lidar"), *self.of_kind("radar"))[0]

    @property
    def is_short(self) -> bool:
        """True if its sensors are named camera, lidar and radar."""
        return all(s.name == s.kind for s in self.sensors)

    def changed(self, change: Callable[[SensorSpec], SensorSpec]) -> RigSpec:
        """The rig with `change` applied to every sensor."""
        return replace(self, sensors=tuple(map(change, self.sensors)))
