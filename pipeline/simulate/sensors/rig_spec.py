"""What a rig is: the data sheets of its sensors, where the drawings put them, and how far cars differ from that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from pipeline.rig.graph import Kind
from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec

__all__ = ["RigSpec", "SensorSpec", "Sheet", "short_rig"]

Triple = tuple[float, float, float]
Sheet = CameraSpec | LidarSpec | RadarSpec


@dataclass(frozen=True)
class SensorSpec:
    """One sensor: its data sheet, its nominal pose in the vehicle frame (rear axle, on the ground), its clock.

    Args:
        name: unique in the rig.
        sheet: what it measures, and how well.
        xyz_m: where it is.
        rpy_deg: turn about the vehicle's axes: roll first, then pitch (positive = nose down), then yaw (to the left).
        delay_s: its stamp of an event less the reference lidar's.
        rate_hz: of a sensor that runs freely; None = the reference lidar triggers it.
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
    """Sensors of a model of car, and how far its cars differ from the drawings.

    Args:
        name: of the rig.
        sensors: cameras, lidars and radars; the first lidar is the reference, whose sweeps are the moments logged.
        delay_sd_s: sd per vehicle of each delay.
        sync_jitter_s: sd of the stamps of triggered sensors.
        prior_rotation_deg: sd per vehicle and sensor of the mounting against CAD, angle.
        prior_translation_m: sd per axis.
        remount_rotation_deg: sd per day and axis.
        remount_translation_m: sd per day and axis.
        behind_m: how far the world reaches behind the vehicle.
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

    def __getitem__(self, name: str) -> SensorSpec:
        """The sensor of that name; KeyError where there is none."""
        return {s.name: s for s in self.sensors}[name]

    def of_kind(self, kind: Kind) -> tuple[SensorSpec, ...]:
        """Sensors of a kind, in the rig's order."""
        return tuple(s for s in self.sensors if s.kind == kind)

    @property
    def reference(self) -> SensorSpec:
        """The first lidar."""
        return self.of_kind("lidar")[0]

    @property
    def is_short(self) -> bool:
        """Whether its sensors are called camera, lidar and radar."""
        return all(s.name == s.kind for s in self.sensors)

    def changed(self, change: Callable[[SensorSpec], SensorSpec]) -> RigSpec:
        """The rig with every sensor changed."""
        return replace(self, sensors=tuple(map(change, self.sensors)))

    def with_sheet(self, name: str, sheet: Sheet) -> RigSpec:
        """The rig with another data sheet for one sensor."""
        return self.changed(lambda s: replace(s, sheet=sheet) if s.name == name else s)


def short_rig(
    name: str,
    camera: CameraSpec,
    lidar: LidarSpec,
    radar: RadarSpec,
    *,
    xyz_m: tuple[Triple, Triple, Triple] = ((1.62, 0.02, 1.62), (1.50, 0.00, 1.80), (1.66, -0.22, 1.58)),
    rpy_deg: tuple[Triple, Triple, Triple] = ((0.0, 0.0, 0.0),) * 3,
    delay_s: tuple[float, float] = (0.012, -0.018),
    free_hz: Triple | None = None,
    **car: Any,
) -> RigSpec:
    """A rig of three sensors called camera, lidar and radar.

    Args:
        name: of the rig.
        camera: its data sheet.
        lidar: likewise.
        radar: likewise.
        xyz_m: of camera, lidar, radar.
        rpy_deg: likewise.
        delay_s: of camera and radar.
        free_hz: rates of camera, lidar and radar that run freely; None = the lidar triggers both.
        **car: as RigSpec's.
    """
    rates, delays = free_hz or (None,) * 3, (delay_s[0], 0.0, delay_s[1])
    rows = zip(
        ("camera", "lidar", "radar"), (camera, lidar, radar), xyz_m, rpy_deg, delays, rates, strict=True
    )
    return RigSpec(name, tuple(SensorSpec(*row) for row in rows), **car)
