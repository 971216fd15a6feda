"""What goes wrong with a vehicle, and bad days: written `vehicle:day:sensor:kind:amount`, several with commas.

Kinds: yaw, pitch, roll [deg] and x, y, z [m] are knocks from that day on, about the vehicle's axes at the sensor; the
same with `drift-` before it grow by the amount per day, starting that day. From that day on `time` [s] lets a sensor
measure earlier than its stamps say, which stay with the others'; `stamp` [s] shifts its stamps, and nothing else.
All of these may begin within their day: amount `0.5@0.6` comes after six tenths of its frames. With `warm-` before it a
turn or shift grows from nothing to the amount from the first frame of that day to its last, and is gone the next day.
Only on that day: `missing` (no data), `swap` (the sensor's topic carries the other point cloud), `intrinsics` (logged
focal length wrong by the fraction), `centre` and `centre-v` (logged principal point too far to the right, or down, by
so many pixels), `labels` (classes permuted), `night` (dark images, outlines three times as loose, classes confused,
half of the boxes missed), `dusk` (dark images, outlines 2 label pixels noisier, half of the boxes missed, nothing
else), `few` (that many frames in all).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_so3
from pipeline.simulate.sensors.rigs import Mounting

__all__ = ["KINDS", "DayFaults", "Fault", "faults_on", "misread", "parse_faults", "shaken"]

_AXES: Final = {"roll": 0, "pitch": 1, "yaw": 2, "x": 0, "y": 1, "z": 2}
_CAMERA_ONLY: Final = ("intrinsics", "centre", "centre-v", "labels", "night", "dusk", "few")
_DAY_ONLY: Final = ("missing", "swap", *_CAMERA_ONLY)
_CLOCKS: Final = ("time", "stamp")
_WARM: Final = "warm-"
KINDS: Final = (*_AXES, *(f"{how}-{a}" for how in ("drift", "warm") for a in _AXES), *_CLOCKS, *_DAY_ONLY)
_SENSORS: Final = {
    **dict.fromkeys(_CLOCKS, ("camera", "radar")),
    "missing": ("camera", "lidar", "radar"),
    "swap": ("lidar", "radar"),
    **dict.fromkeys(_CAMERA_ONLY, ("camera",)),
}


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
    """What is wrong on one vehicle-day, besides where the sensors are."""

    missing: tuple[str, ...] = ()
    swapped: bool = False
    focal_factor: float = 1.0
    centre_shift_px: tuple[float, float] = (0.0, 0.0)
    labels_permuted: bool = False
    night: bool = False
    dusk: bool = False
    frames: int | None = None


def parse_faults(text: str, days: list[str]) -> tuple[Fault, ...]:
    """Faults of a list; a day is one of `days` or its number.

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
        allowed = _SENSORS.get(kind, ("camera", "lidar", "radar"))
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
        if at and (kind in _DAY_ONLY or kind.startswith(_WARM) or not 0 <= fault.after < 1):
            raise ConfigError("--faults", item, f"{kind} cannot begin after {after} of its day")
        faults.append(fault)
    return tuple(faults)


def shaken(
    mounting: Mounting, faults: tuple[Fault, ...], vehicle: str, day: int, share: float = 0.0
) -> Mounting:
    """The mounting after every knock and drift up to a share of a day's frames, and clocks after every shift."""
    changes: dict[str, object] = {}
    for fault in faults:
        is_past = (fault.day, fault.after) <= (day, share)
        is_over = fault.kind.startswith(_WARM) and fault.day < day
        if fault.vehicle != vehicle or not is_past or is_over or fault.kind in _DAY_ONLY:
            continue
        if fault.kind in _CLOCKS:
            # A stamp that is late belongs to an event as much earlier: shifting both leaves the event where it was.
            for name in (f"{fault.sensor}_delay_s", f"{fault.sensor}_phase_s")[: 1 + (fault.kind == "stamp")]:
                changes[name] = float(changes.get(name, getattr(mounting, name))) + fault.amount  # type: ignore[arg-type]
            continue
        how, _, kind = fault.kind.rpartition("-")
        amount = fault.amount * {"drift": day - fault.day + 1, "warm": share, "": 1}[how]
        name = f"T_vehicle_{fault.sensor}"
        T = np.array(changes.get(name, getattr(mounting, name)), np.float64)
        axis = np.eye(3)[_AXES[kind]]
        if kind in ("x", "y", "z"):
            T[:3, 3] += amount * axis
        else:
            T[:3, :3] = exp_so3(np.radians(amount) * axis) @ T[:3, :3]
        changes[name] = T
    return replace(mounting, **changes)  # type: ignore[arg-type]


def faults_on(faults: tuple[Fault, ...], vehicle: str, day: int) -> DayFaults:
    """What is wrong on that day only."""
    today = [f for f in faults if f.vehicle == vehicle and f.day == day]
    kinds = {f.kind: f for f in today}

    def amount(kind: str) -> float:
        return kinds[kind].amount if kind in kinds else 0.0

    return DayFaults(
        missing=tuple(f.sensor for f in today if f.kind == "missing"),
        swapped="swap" in kinds,
        focal_factor=1 + amount("intrinsics"),
        centre_shift_px=(amount("centre"), amount("centre-v")),
        labels_permuted="labels" in kinds,
        night="night" in kinds,
        dusk="dusk" in kinds,
        frames=int(kinds["few"].amount) if "few" in kinds else None,
    )


def misread(camera: Camera, today: DayFaults) -> Camera:
    """The camera as the day's logs describe it: focal length or principal point may be wrong."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= today.focal_factor
    K[:2, 2] += today.centre_shift_px
    return replace(camera, K=K)
