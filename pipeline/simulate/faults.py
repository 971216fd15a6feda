"""What goes wrong with a vehicle, and bad days: written `vehicle:day:sensor:kind:amount`, several with commas.

A sensor goes by its name in the rig.

Kinds: yaw, pitch, roll [deg] and x, y, z [m] are knocks from that day on, about the vehicle's axes at the sensor; the
same with `drift-` before it grow by the amount per day, starting that day. From that day on `time` [s] lets a sensor
measure earlier than its stamps say, which stay with the others'; `stamp` [s] shifts its stamps, and nothing else.
`realign` [deg] is a radar whose software turns its points to the left by so much, and states it; `realign-untold` one
that does not state it.
All of these may begin within their day: amount `0.5@0.6` comes after six tenths of its frames. With `warm-` before it a
turn or shift grows from nothing to the amount from the first frame of that day to its last, and is gone the next day.
Only on that day, and from within it too: `missing` (no data), `stuck` (the first data of each drive are sent again and
again, with new stamps). Only on that day: `swap` (the sensor's topic carries the other point cloud; on a rig of many,
that of the next sensor of its kind, and its own goes there), `intrinsics` (logged focal length wrong by the fraction),
`centre` and `centre-v` (logged principal point too far to the right, or down, by so many pixels), `labels` (classes
permuted). Of the whole vehicle, on that day, named with any camera: `night` (dark images, outlines three times as
loose, classes confused, half of the boxes missed), `dusk` (dark images, outlines 2 label pixels noisier, half of the
boxes missed, nothing else), `few` (that many frames in all).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_so3
from pipeline.simulate.sensors.mounting import Mounted, Mounting
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec
from pipeline.simulate.sensors.rigs import RIGS

__all__ = [
    "KINDS",
    "DayFaults",
    "Fault",
    "faults_on",
    "misread",
    "parse_faults",
    "shaken",
    "states_alignment",
    "swapped_with",
]

_AXES: Final = {"roll": 0, "pitch": 1, "yaw": 2, "x": 0, "y": 1, "z": 2}
_CAMERA_ONLY: Final = ("intrinsics", "centre", "centre-v", "labels", "night", "dusk", "few")
_SENT: Final = ("missing", "stuck")
_DAY_ONLY: Final = (*_SENT, "swap", *_CAMERA_ONLY)
_CLOCKS: Final = ("time", "stamp")
_REALIGNED: Final = ("realign", "realign-untold")
_WARM: Final = "warm-"
KINDS: Final = (
    *_AXES,
    *(f"{how}-{a}" for how in ("drift", "warm") for a in _AXES),
    *_CLOCKS,
    *_REALIGNED,
    *_DAY_ONLY,
)


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong; `day` counts from 0, amounts in deg, m, s, a fraction or a count, by kind.

    `after` is the share of the day's frames that a knock, a drift or a shifted clock spares.
    """

    vehicle: str
    day: int
    sensor: str
    kind: str
    amount: float
    after: float = 0.0


@dataclass(frozen=True)
class DayFaults:
    """What is wrong on one vehicle-day after a share of its frames, besides where the sensors are."""

    faults: tuple[Fault, ...] = ()

    def has(self, kind: str, sensor: str | None = None) -> bool:
        """Whether a kind of fault is there, of any sensor or of the named one."""
        return any(f.kind == kind and sensor in (None, f.sensor) for f in self.faults)

    def amount(self, kind: str, sensor: str | None = None) -> float:
        """Its amount; 0 where it is not there."""
        return sum((f.amount for f in self.faults if f.kind == kind and sensor in (None, f.sensor)), 0.0)


def parse_faults(text: str, days: list[str], rig: RigSpec = RIGS["demo"]) -> tuple[Fault, ...]:
    """Faults of a list; a day is one of `days` or its number, a sensor one of the rig's.

    Raises:
        ConfigError: wrong number of parts, unknown day, sensor or kind, amount that is no number.
    """
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
    """Sensors of a rig that a kind of fault can happen to."""
    if kind in _CLOCKS:  # the reference lidar's clock is what the others are compared with
        return [s.name for s in rig.sensors if s != rig.reference]
    if kind in _REALIGNED:
        return [s.name for s in rig.of_kind("radar")]
    if kind == "swap":
        return [s.name for s in rig.sensors if s.kind != "camera" and swapped_with(s, rig) is not None]
    return [s.name for s in rig.sensors if kind not in _CAMERA_ONLY or s.kind == "camera"]


def states_alignment(faults: tuple[Fault, ...]) -> bool:
    """Whether radars of the fleet state their own alignment: where one of them is aligned anew."""
    return any(fault.kind in _REALIGNED for fault in faults)


def swapped_with(sensor: SensorSpec, rig: RigSpec) -> SensorSpec | None:
    """The sensor that another's cable can be mistaken for: the next of its kind, or the other of lidar and radar."""
    if rig.is_short:
        return rig["radar" if sensor.kind == "lidar" else "lidar"]
    alike = rig.of_kind(sensor.kind)
    return alike[(alike.index(sensor) + 1) % len(alike)] if len(alike) > 1 else None


def shaken(
    mounting: Mounting, faults: tuple[Fault, ...], vehicle: str, day: int, share: float = 0.0
) -> Mounting:
    """The mounting after every knock and drift up to a share of a day's frames, and clocks after every shift."""
    sensors = dict(mounting.sensors)
    for fault in faults:
        is_past = (fault.day, fault.after) <= (day, share)
        is_over = fault.kind.startswith(_WARM) and fault.day < day
        if fault.vehicle == vehicle and is_past and not is_over and fault.kind not in _DAY_ONLY:
            sensors[fault.sensor] = _moved(sensors[fault.sensor], fault, day, share)
    return Mounting(sensors)


def _moved(mounted: Mounted, fault: Fault, day: int, share: float) -> Mounted:
    """A sensor after one knock, drift or shift of its clock."""
    if fault.kind in _CLOCKS:
        # A stamp that is late belongs to an event as much earlier: shifting both leaves the event where it was.
        phase_s = mounted.phase_s + (fault.amount if fault.kind == "stamp" else 0.0)
        return replace(mounted, delay_s=mounted.delay_s + fault.amount, phase_s=phase_s)
    if fault.kind in _REALIGNED:
        angle = float(np.radians(fault.amount))
        stated = angle if fault.kind == "realign" else 0.0
        return replace(mounted, turned_rad=mounted.turned_rad + angle, stated_rad=mounted.stated_rad + stated)
    how, _, kind = fault.kind.rpartition("-")
    amount = fault.amount * {"drift": day - fault.day + 1, "warm": share, "": 1}[how]
    T = mounted.T_vehicle.copy()
    axis = np.eye(3)[_AXES[kind]]
    if kind in ("x", "y", "z"):
        T[:3, 3] += amount * axis
    else:
        T[:3, :3] = exp_so3(np.radians(amount) * axis) @ T[:3, :3]
    return replace(mounted, T_vehicle=T)


def faults_on(faults: tuple[Fault, ...], vehicle: str, day: int, share: float = 1.0) -> DayFaults:
    """What is wrong on that day only, after a share of its frames."""
    return DayFaults(tuple(f for f in faults if f.vehicle == vehicle and f.day == day and f.after <= share))


def misread(camera: Camera, today: DayFaults, name: str) -> Camera:
    """A camera as the day's logs describe it: focal length or principal point may be wrong."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + today.amount("intrinsics", name)
    K[:2, 2] += (today.amount("centre", name), today.amount("centre-v", name))
    return replace(camera, K=K)
