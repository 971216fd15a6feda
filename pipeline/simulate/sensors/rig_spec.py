"""Specification of a rig: data sheets of its sensors, nominal poses, and deviations of cars from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from pipeline.rig.graph import Kind
from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec

__all__ = ["RigSpec", "SensorSpec", "Sheet", "Triple"]

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
        prior_translation_m: sd per axis.
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
