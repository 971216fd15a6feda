"""Faults of sensors, and bad days: written `vehicle:day:sensor:kind:amount`, separated by commas.

Sensors are named as in the rig.

Kinds: yaw, pitch, roll [deg] and x, y, z [m] move a sensor from that day on, about the vehicle's axes at the
sensor; with the prefix `drift-` they grow by the amount per day, starting that day. From that day on, `time`
[s] lets a sensor measure earlier than its stamps, which stay aligned with the others; `stamp` [s] shifts only
its stamps. All of these may start within their day: amount `0.5@0.6` starts after six tenths of its frames.
With the prefix `warm-` a rotation or shift grows from zero at the first frame of that day to the amount at
its last, and is gone the next day. Only on that day, also starting within it: `missing` (no data), `stuck` (the first
data of each drive are repeated with new stamps). Only on that day: `swap` (the sensor's topic has the other
point cloud; in a rig of many sensors, that of the next sensor of its kind, and vice versa), `intrinsics`
(logged focal length wrong by the fraction), `centre` and `centre-v` (logged principal point too far to the
right, or down, by this many pixels), `labels` (classes permuted). For the whole vehicle on that day, written
with any camera: `night` (dark images, outlines three times as noisy, confused classes, half of the boxes
missed), `dusk` (dark images, outlines 2 label pixels noisier, half of the boxes missed), `few` (this many
frames in total).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera
from pipeline.simulate.sensors.mounting import Mounted, Mounting, disturbed
from pipeline.simulate.sensors.rig_spec import CameraSpec, RigSpec, SensorSpec
from pipeline.simulate.sensors.rigs import RIGS
from pipeline.simulate.sensors.semantics import SemanticsSpec

__all__ = [
    "KINDS", "DayFaults", "Fault", "faults_on", "misread", "networks_on", "parse_faults", "shaken",
    "swapped_with",
]  # fmt: skip

_AXES: Final = {"roll": 0, "pitch": 1, "yaw": 2, "x": 0, "y": 1, "z": 2}
_CAMERA_ONLY: Final = ("intrinsics", "centre", "centre-v", "labels", "night", "dusk", "few")
_SENT: Final = ("missing", "stuck")
_DAY_ONLY: Final = (*_SENT, "swap", *_CAMERA_ONLY)
_CLOCKS: Final = ("time", "stamp")
_WARM: Final = "warm-"
KINDS: Final = (*_AXES, *(f"{how}-{a}" for how in ("drift", "warm") for a in _AXES), *_CLOCKS, *_DAY_ONLY)


@dataclass(frozen=True)
class Fault:
    """One fault; `day` counts from 0, amounts are in deg, m, s, a fraction or a count, by kind.

    `after` is the share of the day's frames before the start of a move, drift or clock shift.
    """

    vehicle: str
    day: int
    sensor: str
    kind: str
    amount: float
    after: float = 0.0


@dataclass(frozen=True)
class DayFaults:
    """Faults of one vehicle-day after a share of its frames, except changes of the mounting."""

    faults: tuple[Fault, ...] = ()

    def has(self, kind: str, sensor: str | None = None) -> bool:
        """True if a kind of fault is present, for any sensor or for the named one."""
        return any(f.kind == kind and sensor in (None, f.sensor) for f in self.faults)

    def amount(self, kind: str, sensor: str | None = None) -> float:
        """Amount of the fault; 0 if it is not present."""
        return sum((f.amount for f in self.faults if f.kind == kind and sensor in (None, f.sensor)), 0.0)


def parse_faults(text: str, days: list[str], rig: RigSpec = RIGS["demo"]) -> tuple[Fault, ...]:
    """Parse a list of faults; a day is one of `days` or its number. ConfigError if one is invalid."""
    faults = []
    for item in filter(None, re.split(r"[,\s]+", text)):
        parts = item.split(":")
        if len(parts) != 5:
            raise ConfigError("--faults", item, "expected vehicle:day:sensor:kind:amount")
        vehicle, day, sensor, kind, amount = parts
        if kind not in KINDS:
            raise ConfigError("--faults", item, f"kind {kind!r} is not one of {', '.join(KINDS)}")
        allowed = _sensors(kind, rig)
        if sensor not in allowed:
            raise ConfigError(
                "--faults", item, f"{kind} happens to {' or '.join(allowed)}, not to {sensor!r}"
            )
        number = days.index(day) if day in days else int(day) if day.isdigit() else -1
        if not 0 <= number < len(days):
            raise ConfigError("--faults", item, f"day {day!r} is not one of {', '.join(days)} nor its number")
        size, at, after = amount.partition("@")
        try:
            fault = Fault(vehicle, number, sensor, kind, float(size), float(after) if at else 0.0)
        except ValueError as err:
            raise ConfigError("--faults", item, f"amount {amount!r} is no number") from err
        whole = kind in set(_DAY_ONLY) - set(_SENT) or kind.startswith(_WARM)
        if at and (whole or not 0 <= fault.after < 1):
            raise ConfigError("--faults", item, f"{kind} cannot begin after {after} of its day")
        faults.append(fault)
    return tuple(faults)


def _sensors(kind: str, rig: RigSpec) -> list[str]:
    """Sensors of a rig that a kind of fault applies to."""
    if kind in _CLOCKS:  # other clocks are compared with the reference lidar's
        return [s.name for s in rig.sensors if s != rig.reference]
    if kind == "swap":
        return [s.name for s in rig.sensors if s.kind != "camera" and swapped_with(s, rig) is not None]
    return [s.name for s in rig.sensors if kind not in _CAMERA_ONLY or s.kind == "camera"]


def swapped_with(sensor: SensorSpec, rig: RigSpec) -> SensorSpec | None:
    """The sensor to swap with: the next of its kind, or the other of lidar and radar; None without one."""
    if rig.is_short:
        return rig["radar" if sensor.kind == "lidar" else "lidar"]
    alike = rig.of_kind(sensor.kind)
    return alike[(alike.index(sensor) + 1) % len(alike)] if len(alike) > 1 else None


def shaken(
    mounting: Mounting, faults: tuple[Fault, ...], vehicle: str, day: int, share: float = 0.0
) -> Mounting:
    """Mounting after all moves and drifts up to a share of a day's frames, and clocks after all shifts."""
    sensors = dict(mounting.sensors)
    for fault in faults:
        is_past = (fault.day, fault.after) <= (day, share)
        is_over = fault.kind.startswith(_WARM) and fault.day < day
        if fault.vehicle == vehicle and is_past and not is_over and fault.kind not in _DAY_ONLY:
            sensors[fault.sensor] = _moved(sensors[fault.sensor], fault, day, share)
    return Mounting(sensors)


def _moved(mounted: Mounted, fault: Fault, day: int, share: float) -> Mounted:
    """A sensor after one move, drift or clock shift."""
    if fault.kind in _CLOCKS:
        # A late stamp belongs to an earlier event: shifting both keeps the time of the event.
        phase_s = mounted.phase_s + (fault.amount if fault.kind == "stamp" else 0.0)
        return replace(mounted, delay_s=mounted.delay_s + fault.amount, phase_s=phase_s)
    how, _, kind = fault.kind.rpartition("-")
    amount = fault.amount * {"drift": day - fault.day + 1, "warm": share, "": 1}[how]
    step, still = amount * np.eye(3)[_AXES[kind]], np.zeros(3)
    rotation, shift = (still, step) if kind in ("x", "y", "z") else (np.radians(step), still)
    return replace(mounted, T_vehicle=disturbed(mounted.T_vehicle, rotation, shift))


def faults_on(faults: tuple[Fault, ...], vehicle: str, day: int, share: float = 1.0) -> DayFaults:
    """Faults limited to that day, after a share of its frames."""
    return DayFaults(tuple(f for f in faults if f.vehicle == vehicle and f.day == day and f.after <= share))


def misread(sensor: SensorSpec, today: DayFaults) -> Camera:
    """The camera in the day's logs: focal length or principal point may be wrong."""
    assert isinstance(sensor.sheet, CameraSpec)
    camera, name = sensor.sheet.nominal(), sensor.name
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + today.amount("intrinsics", name)
    K[:2, 2] += (today.amount("centre", name), today.amount("centre-v", name))
    return replace(camera, K=K)


def networks_on(today: DayFaults) -> SemanticsSpec:
    """Errors of networks; at night those of day-trained ones: outlines three times as noisy, half of the boxes missed.

    At dusk outlines are 2 label pixels noisier; classes of visible objects are as reliable as by day.
    """
    spec = SemanticsSpec()
    if today.has("dusk"):
        return replace(spec, boundary_px=spec.boundary_px + 2.0, miss=0.5)
    if not today.has("night"):
        return spec
    return replace(
        spec, boundary_px=3 * spec.boundary_px, confusion=0.35, miss=0.5, box_jitter=3 * spec.box_jitter,
        false_boxes=3 * spec.false_boxes,
    )  # fmt: skip
