"""Counts of a checked data set: right, wrong, undecided; and the share of known turns that were called wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from scipy.stats import beta

from pipeline.verify.faults import FAULTS_OF
from pipeline.verify.one_axis import HeldOut, power_of
from schemas.set_checks import SetCheck

__all__ = ["Look", "by_fault", "by_sensor", "by_shipped", "by_turn", "interval", "looks_of"]

_ANSWERS = ("right", "wrong", "undecided")
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Look:
    """Axes of one sensor in one log, as shipped or with one turn; `shipped` are those without the turn."""

    axes: tuple[SetCheck, ...]
    shipped: tuple[SetCheck, ...]

    @property
    def row(self) -> SetCheck:
        """The row of one axis, to read columns that are the same for all axes of a look."""
        return self.axes[0]

    @property
    def is_turned(self) -> bool:
        """Whether this sensor, and not another one, was turned."""
        return self.row.turn_sensor == self.row.sensor and not self.row.fault

    @property
    def was_wrong(self) -> bool:
        """Whether the sensor is called wrong as shipped."""
        return bool(self.shipped) and self.shipped[0].answer == "wrong"


def looks_of(rows: Iterable[SetCheck]) -> list[Look]:
    """Rows grouped by log, turn and sensor; logs without any answer are left out."""
    found: dict[tuple[str, ...], list[SetCheck]] = {}
    for row in rows:
        if row.sensor:
            found.setdefault((row.vehicle, row.day, row.log, row.sensor, row.turn), []).append(row)
    return [Look(tuple(own), tuple(found.get((*key[:-1], ""), ()))) for key, own in found.items()]


def interval(hits: int, trials: int) -> tuple[float, float]:
    """Clopper and Pearson's 95 % interval of a rate; one-sided if none or all succeed (about 3 / trials wide)."""
    if not 0 <= hits <= trials or trials < 1:
        raise ValueError(f"{hits} of {trials} is no rate")
    outside = 1 - _CONFIDENCE if hits in {0, trials} else (1 - _CONFIDENCE) / 2
    low = float(beta.ppf(outside, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - outside, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def by_sensor(looks: Sequence[Look]) -> list[dict[str, Any]]:
    """For each sensor of each rig: answers as shipped, medians of each axis, inputs read, and undetected errors."""
    found = []
    shipped = [k for k in looks if not k.row.turn]
    for (rig, sensor), own in _grouped(shipped, lambda k: (k.row.rig, k.row.sensor)):
        axes = dict.fromkeys(c.axis for k in own for c in k.axes)
        passes = [k.row.passes_rad for k in own]
        sources = sorted({name for p in passes for name in p})
        found.append(
            {"rig": rig, "sensor": sensor, "kind": own[0].row.kind, **_counts(own)}
            | {"axes": {axis: _axis([c for k in own for c in k.axes if c.axis == axis]) for axis in axes}}
            | {"reads": list(dict.fromkeys(source for k in own for source in k.row.reads))}
            | {"passes_deg": {name: _deg(p.get(name) for p in passes) for name in sources}}
        )
    return found


def by_shipped(looks: Sequence[Look]) -> list[dict[str, Any]]:
    """For each distinct shipped calibration and each of its sensors: the answers of its logs."""
    grouped = _grouped([k for k in looks if not k.row.turn], lambda k: (k.row.shipped, k.row.sensor))
    return [{"shipped": shipped, "sensor": sensor, **_counts(own)} for (shipped, sensor), own in grouped]


def by_turn(looks: Sequence[Look]) -> list[dict[str, Any]]:
    """For each sensor, axis and size of a turn: numbers of answers wrong, right and undecided.

    `axis_open` is the number of right answers that are inconclusive in the turned axis. Sensors that are
    wrong as shipped are left out and counted (`left_out`), because a turn may lead back to the right pose.
    `stated` is the share of wrong answers predicted by the sigmas as shipped. `blamed` is the number of turns
    after which another sensor became wrong.
    """
    blamed = {
        _log(k)
        for k in looks
        if k.row.turn_axis and not k.is_turned and k.row.answer == "wrong" and not k.was_wrong
    }
    found = []
    turned = _grouped(
        [k for k in looks if k.is_turned],
        lambda k: (k.row.rig, k.row.sensor, k.row.turn_axis, abs(k.row.turn_deg)),
    )
    for (rig, sensor, axis, deg), own in turned:
        sound = [k for k in own if not k.was_wrong]
        plus = [k for k in sound if k.row.turn_deg > 0]
        found.append(
            {"rig": rig, "sensor": sensor, "axis": axis, "deg": deg, **_counts(sound)}
            | {"plus": _counts(plus), "minus": _counts([k for k in sound if k not in plus])}
            | {
                "axis_open": sum(
                    k.row.answer == "right" and _status(k, axis) == "inconclusive" for k in sound
                )
            }
            | {"left_out": len(own) - len(sound), "blamed": sum(_log(k) in blamed for k in sound)}
            | {"stated": float(np.mean([_stated(k, axis) for k in sound])) if sound else None}
        )
    return found


def by_fault(looks: Sequence[Look]) -> list[dict[str, Any]]:
    """For each fault and sensor that it affects: numbers of answers wrong, undecided, and still right.

    A camera's fault affects the camera, a lidar's fault every sensor. Sensors that are wrong as shipped are
    left out and counted. `lost` is the number of sensors that were right as shipped, but not with the fault.
    """
    found = []
    touched = [
        k
        for k in looks
        if k.row.fault and (k.row.turn_sensor == k.row.sensor or k.row.fault in FAULTS_OF["lidar"])
    ]
    for (rig, fault, sensor), own in _grouped(touched, lambda k: (k.row.rig, k.row.fault, k.row.sensor)):
        sound = [k for k in own if not k.was_wrong]
        lost = [k for k in sound if k.shipped and k.shipped[0].answer == "right" and k.row.answer != "right"]
        found.append(
            {"rig": rig, "fault": fault, "sensor": sensor, **_counts(sound)}
            | {"lost": len(lost), "left_out": len(own) - len(sound)}
        )
    return found


def _log(look: Look) -> tuple[str, ...]:
    return look.row.vehicle, look.row.day, look.row.log, look.row.turn


def _counts(looks: Sequence[Look]) -> dict[str, Any]:
    counts: dict[str, Any] = {a: sum(k.row.answer == a for k in looks) for a in _ANSWERS}
    return counts | {
        "looks": len(looks),
        "wrong_interval": interval(counts["wrong"], len(looks)) if looks else None,
    }


def _grouped(
    looks: Iterable[Look], key: Callable[[Look], tuple[Any, ...]]
) -> list[tuple[tuple[Any, ...], list[Look]]]:
    found: dict[tuple[Any, ...], list[Look]] = {}
    for look in looks:
        found.setdefault(key(look), []).append(look)
    return sorted(found.items(), key=lambda item: item[0])


def _axis(checks: Sequence[SetCheck]) -> dict[str, Any]:
    names = ("off", "sigma", "shown", "asked", "limit")
    statuses = {s: sum(c.status == s for c in checks) for s in ("pass", "warn", "fail", "inconclusive")}
    power = median(c.power or 0.0 for c in checks)
    return (
        {f"{n}_deg": _deg(getattr(c, f"{n}_rad") for c in checks) for n in names}
        | statuses
        | {"power": power}
    )


def _deg(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.degrees(median(known))) if known else None


def _status(look: Look, axis: str) -> str:
    return next((c.status for c in look.axes if c.axis == axis), "inconclusive")


def _stated(look: Look, axis: str) -> float:
    """Probability that a turn of this size is called wrong, from the sigma and the held-out test as shipped."""
    check = next((c for c in look.shipped if c.axis == axis), None)
    if (
        check is None
        or not check.power
        or check.sigma_rad is None
        or check.limit_rad is None
        or check.beyond is None
    ):
        return 0.0
    said = HeldOut({float(deg): z for deg, z in check.held_out_z.items()})
    size = float(np.radians(abs(look.row.turn_deg)))
    return power_of(size, check.limit_rad, check.sigma_rad, check.beyond, said)
