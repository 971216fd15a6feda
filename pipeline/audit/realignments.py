"""Radars that align themselves: a step of their own estimate rotates their points, and moves no mount.

Charts and states of such a radar restart, as after a service event that names the radar's software. A step
that does not fit the change of the radar's edges restarts nothing, so that a knock is not mistaken for it.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.audit.days import PairDays
from pipeline.audit.estimates import Estimates, days_of
from pipeline.config import AuditConfig
from pipeline.extrinsics.radar_turn import turn_of_radar
from pipeline.rig.graph import Edge
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, work_key
from pipeline.store.records import read_columns, read_records
from schemas.radar_alignments import RADAR_ALIGNMENTS
from schemas.service_events import REALIGNED, SERVICE_EVENTS, ServiceEvent

__all__ = ["Realignments", "find_realignments"]

_AXES = ("azimuth", "elevation")
_COLUMNS = ("sign_is_published", *(f"{a}_{what}_rad" for a in _AXES for what in ("scatter", "step")))
_BEST_FIRST = ("lidar_radar", "camera_radar", "radar_base")
# A day's sigma errs by some tenths, and a step is asked once per radar and year: 4 sigmas are then rare enough.
_SIGMAS = 4.0
_DAYS_BEFORE = 14  # of the radar's edges, that a step is compared with


@dataclass(frozen=True)
class Realignments:
    """Re-alignments of a window that service events do not have yet; and, by radar, steps that do not fit."""

    events: tuple[ServiceEvent, ...]
    remarks: Mapping[tuple[str, str], str]


@dataclass(frozen=True, eq=False)
class _Step:
    """A step of a radar's own estimate: the last day with the old one, the first with the new one, its size."""

    last_old: str
    first_new: str
    size_rad: Float[np.ndarray, " 2"]  # NaN where the messages state no such angle
    sign_is_published: bool


def find_realignments(
    lake: Lake,
    method: str,
    window: tuple[str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    records: Estimates,
    config: AuditConfig,
) -> Realignments:
    """Steps of radars' own estimates within a window of days, each followed from its last noted event on."""
    table = read_columns(
        lake, RADAR_ALIGNMENTS, ("azimuth_rad", "elevation_rad", *_COLUMNS), first=window[0], last=window[1]
    )
    if table is None:
        return Realignments((), {})
    rows = current_rows(table.filter(pc.equal(table["method"], method)), RADAR_ALIGNMENTS)
    noted = {
        (e.vehicle, e.sensor, e.day)
        for e in read_records(lake, SERVICE_EVENTS, ServiceEvent, last=window[1])
        if e.kind == REALIGNED
    }
    least_rad = float(np.radians(config.radar_limit_deg)) / 2
    found, remarks = list[ServiceEvent](), dict[tuple[str, str], str]()
    for (vehicle, sensor), days in _by_radar(rows):
        others = [
            e.day for e in events.get(vehicle, ()) if e.sensor in ("all", sensor) and e.kind != REALIGNED
        ]
        steps = _steps([d for d in days if d["day"] > max(others, default="")], least_rad)
        if not steps:
            continue
        edges = days_of(records.of(vehicle), config.held_sigma_factor)
        for step in (s for s in steps if (vehicle, sensor, s.last_old) not in noted):
            turned = _turned(sensor, edges, step)
            text = _in_words(step, turned)
            if turned is not None and _fits(step, *turned, least_rad):
                key = work_key(REALIGNED, "", f"{vehicle} {step.last_old} {sensor}", [text])
                event = ServiceEvent(
                    vehicle=vehicle, day=step.last_old, sensor=sensor, kind=REALIGNED, note=text, work_key=key
                )
                found.append(event)
            else:
                otherwise = "" if turned is None else " otherwise"
                remarks[vehicle, sensor] = f"the {sensor}'s own estimate changed{otherwise} ({text})"
    return Realignments(tuple(found), remarks)


def _by_radar(rows: pa.Table) -> list[tuple[tuple[str, str], list[dict[str, Any]]]]:
    """Rows of each vehicle and radar, in order of days."""
    listed = sorted(rows.to_pylist(), key=lambda r: (r["vehicle"], r["sensor"], r["day"]))
    return [(key, list(own)) for key, own in groupby(listed, key=lambda r: (r["vehicle"], r["sensor"]))]


def _steps(days: Sequence[Mapping[str, Any]], least_rad: float) -> list[_Step]:
    """Steps of the estimate from its level since the window began or since the last step.

    A step counts from half of the limit on, so that smaller ones cannot alarm by themselves, and beyond its
    days' scatter.
    """
    levels = np.array([_levels(day) for day in days]).reshape(-1, 2, 2)  # day, morning and evening, axis
    least = np.maximum(least_rad, _SIGMAS * np.sqrt(2) * _day_sigma(days, levels))
    steps, old = list[_Step](), np.full(2, np.nan)
    for k, day in enumerate(days):
        for part, level in enumerate(levels[k]):
            old = np.where(np.isnan(old), level, old)
            size = level - old
            if (np.abs(size) > least).any():
                last_old = day if part else days[k - 1]
                steps.append(_Step(last_old["day"], day["day"], size, day["sign_is_published"]))
                old = np.where(np.isnan(level), old, level)
    return steps


def _levels(day: Mapping[str, Any]) -> list[list[float]]:
    """Azimuth and elevation before and after a step within the day; the same twice without one."""
    evening = [_number(day[f"{axis}_rad"]) for axis in _AXES]
    steps = [_number(day[f"{axis}_step_rad"]) for axis in _AXES]
    return [[e - (0.0 if np.isnan(s) else s) for e, s in zip(evening, steps, strict=True)], evening]


def _day_sigma(
    days: Sequence[Mapping[str, Any]], levels: Float[np.ndarray, "N 2 2"]
) -> Float[np.ndarray, " 2"]:
    """By how much an axis scatters from day to day, robustly; of few days, by how much its messages do."""
    jumps = np.abs(levels[1:, 0] - levels[:-1, 1])
    if len(jumps) > 2:
        return 1.4826 / np.sqrt(2) * _median(jumps)
    return _median(np.array([[_number(day[f"{axis}_scatter_rad"]) for axis in _AXES] for day in days]))


def _median(values: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " 2"]:
    """Median of each column without NaN; 0 for an empty column."""
    columns = [column[~np.isnan(column)] for column in values.T]
    return np.array([np.median(column) if len(column) else 0.0 for column in columns])


def _turned(
    sensor: str, edges: Mapping[Edge, PairDays], step: _Step
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]] | None:
    """Azimuth and elevation of the radar's apparent rotation since the step, by its best edge, and sigmas.

    None if no edge has days on both sides.
    """
    first, last = (dt.date.fromisoformat(day).toordinal() for day in (step.first_new, step.last_old))
    own = [e for e in edges if e.kind in _BEST_FIRST and sensor in (s.name for s in e.sensors)]
    for edge in sorted(own, key=lambda e: (_BEST_FIRST.index(e.kind), e.name)):
        days = edges[edge]
        # A day within which it stepped belongs to neither side, but of the last day its last part is known.
        after = days.day > last if (days.day > last).any() else days.day >= first
        sides = [days.day < first if first == last else days.day <= last, after]
        sides[0] &= days.day > last - _DAYS_BEFORE
        if not all(side.any() for side in sides):
            continue
        A = turn_of_radar(edge, days.origin)
        turns, spread = days.change[:, :3] @ A.T, A @ days.spread[:, :3, :3] @ A.T
        variances = np.einsum("nii->ni", spread)
        (before, early), (after, late) = (_mean(turns[side], variances[side]) for side in sides)
        off = (turns[sides[0]] - before) ** 2 / variances[sides[0]]
        # Days scatter by more than their sigmas; one alone does not show it.
        excess = np.maximum(off.sum(axis=0) / max(len(off) - 1, 1), 1.0)
        return after - before, np.sqrt(excess * (early + late))
    return None


def _mean(
    turns: Float[np.ndarray, "N 2"], variances: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Weighted mean of some days, and its variances."""
    variance = 1 / (1 / variances).sum(axis=0)
    return variance * (turns / variances).sum(axis=0), variance


def _fits(
    step: _Step, turned: Float[np.ndarray, " 2"], sigma: Float[np.ndarray, " 2"], least_rad: float
) -> bool:
    """Whether software that turned the points explains how the edges changed, better than a mount or nothing that did.

    It need not explain what cannot alarm by itself. Points that turn to the left look as a radar does that
    was turned to the right. Of makers that publish no sign either is the software's.
    """
    known = ~np.isnan(step.size_rad)
    off = {sign: np.abs(turned - sign * step.size_rad)[known] for sign in (-1, 0, 1)}
    of_software = (-1,) if step.sign_is_published else (-1, 1)
    best = min(off, key=lambda sign: float(((off[sign] / sigma[known]) ** 2).sum()))
    return best in of_software and bool((off[best] < np.maximum(_SIGMAS * sigma[known], least_rad)).all())


def _in_words(step: _Step, turned: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]] | None) -> str:
    """As `2026-03-05: +0.30 deg in azimuth; its edges turned by -0.28 ± 0.08 deg in azimuth`."""
    known = [k for k in range(2) if not np.isnan(step.size_rad[k])]
    degrees = np.degrees(step.size_rad)
    text = f"{step.first_new}: " + ", ".join(f"{degrees[k]:+.2f} deg in {_AXES[k]}" for k in known)
    if turned is None:
        return f"{text}; no edge has days before and after"
    own = [f"{v:+.2f} ± {s:.2f} deg" for v, s in np.degrees(np.array(turned)).T]
    return f"{text}; its edges turned by {' and '.join(f'{own[k]} in {_AXES[k]}' for k in known)}"


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
