"""Fixed references in table states, so that a night need not read vehicles' first days again.

A stored reference is valid with the same service event and setting, unless a record of an older day became
current.

Also from which day on a sensor's days count: since the sensor, or the reference that its pose refers to, last moved.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.audit.days import PairDays, Reference, reference_of
from pipeline.audit.estimates import day_name
from pipeline.audit.reasons import REASONS, because
from pipeline.rig.graph import Edge, Sensor, edge_of
from pipeline.rig.se3 import from_quaternion, to_quaternion
from pipeline.store.current import current_events
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_columns, read_latest, read_records
from schemas.calibrations import CALIBRATIONS
from schemas.columns import POSE_COLUMNS
from schemas.drift import DriftFinding
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from schemas.states import STATES, StateRow

__all__ = [
    "Kept", "drift_per_day", "events_until", "first_accepted", "kept_columns", "kept_of", "last_restart",
    "read_kept", "restart_of",
]  # fmt: skip

_COLUMNS = tuple(c.name for c in STATES.columns if c.name.startswith("reference_"))
# Records that were committed while a night's audit ran may be younger than what it read, and older than its states.
_MARGIN = dt.timedelta(days=1)


@dataclass(frozen=True, eq=False)
class Kept:
    """Stored reference of an edge: last service event, first accepted days since, mean of enough days."""

    since: str
    days: tuple[str, ...]
    reference: Reference | None = None


def read_kept(
    lake: Lake,
    method: str,
    window: tuple[str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    count: int,
) -> dict[tuple[str, Edge], Kept]:
    """Valid references of the last states, by vehicle and edge."""
    first, last = window
    eve = days_after(first, -1)
    rows = read_latest(lake, STATES, StateRow, first=eve, last=last, columns=_COLUMNS)
    # Of a night that was run again the last one counts.
    last_said = {(s.vehicle, edge_of(s)): s for s in rows if s.method == method and s.pair != "pose"}
    states = {key: s for key, s in last_said.items() if s.reference_days is not None}
    changed = _changed_since(lake, last, {s.vehicle: s.recorded_at for s in states.values()})
    kept = {}
    for (vehicle, edge), state in states.items():
        event = restart_of(events.get(vehicle, ()), edge, last)
        same = (state.reference_since or "") == ("" if event is None else event.day)
        own, since = _kept(state), changed.get(vehicle, last)
        if same and state.reference_count == count and since >= first:
            # Among the days that are read anyway, its own may be others now.
            is_whole = not own.days or since > own.days[-1]
            kept[vehicle, edge] = own if is_whole else replace(own, reference=None)
    return kept


def first_accepted(kept: Kept | None) -> str | None:
    """First day from which to search for accepted days; None if no accepted day is known."""
    if kept is None:
        return ""
    return kept.days[0] if kept.days else None


def kept_of(days: PairDays | None, since: str, count: int) -> Kept:
    """Reference of an edge from its days since the service event `since` (empty = none)."""
    if days is None:
        return Kept(since, ())
    accepted = days.day[days.accepted][:count]
    found = tuple(day_name(int(day)) for day in accepted)
    return Kept(since, found, reference_of(days, count) if len(found) == count else None)


def kept_columns(kept: Kept, count: int) -> dict[str, Any]:
    """The columns of table states that keep a reference."""
    columns: dict[str, Any] = {
        "reference_days": list(kept.days),
        "reference_since": kept.since or None,
        "reference_count": count,
    }
    made = kept.reference
    if made is None:
        return columns
    pose = [*to_quaternion(made.T).tolist(), *made.T[:3, 3].tolist()]
    return columns | {
        "reference_used": len(made.days),
        **{f"reference_{name}": float(value) for name, value in zip(POSE_COLUMNS, pose, strict=True)},
        "reference_covariance": made.spread,
        "reference_observable": [bool(v) for v in made.observable],
    }


def _kept(state: StateRow) -> Kept:
    days = tuple(state.reference_days or ())
    pose = [getattr(state, f"reference_{name}") for name in POSE_COLUMNS]
    if state.reference_covariance is None or None in pose:
        return Kept(state.reference_since or "", days)
    ordinals = tuple(dt.date.fromisoformat(day).toordinal() for day in days[: state.reference_used])
    T = from_quaternion(np.array(pose[:4]), np.array(pose[4:]))
    observable = np.array(state.reference_observable, bool)
    made = Reference(ordinals, T, np.array(state.reference_covariance), observable)
    return Kept(state.reference_since or "", days, made)


def _changed_since(lake: Lake, last: str, recorded_at: Mapping[str, str]) -> dict[str, str]:
    """For each vehicle, the first day until `last` with a record that became current after its states were recorded."""
    if not recorded_at:
        return {}
    after = {vehicle: _before(stamp) for vehicle, stamp in recorded_at.items()}
    found = read_columns(lake, CALIBRATIONS, (), first=None, last=last, asserted_after=min(after.values()))
    changed: dict[str, str] = {}
    names = ("vehicle", "day", "asserted_at")
    for vehicle, day, stamp in (
        zip(*(found[n].to_pylist() for n in names), strict=True) if found is not None else ()
    ):
        if stamp > after.get(vehicle, ""):
            changed[vehicle] = min(day, changed.get(vehicle, day))
    return changed


def _before(stamp: str) -> str:
    return (dt.datetime.fromisoformat(stamp) - _MARGIN).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


_ALARMS = ("RED", "YELLOW")


def last_restart(
    sensor: Sensor,
    reference: Sensor,
    events: Sequence[ServiceEvent],
    findings: Sequence[DriftFinding],
    last_day: str,
) -> tuple[str, str]:
    """First day that counts for a sensor's pose, and why; empty if all days do.

    The day of a service event belongs to neither side, because the drive may be before or after it. Where the audit
    cannot tell which end of an edge moved, either may have.
    """
    ends = {sensor.name, reference.name}
    event = _last_touching(events, ends, last_day)
    first, why = "", ""
    if event is not None:
        first, why = days_after(event.day, 1), because("after work", event=event.in_words)
    for finding in findings:
        begin = finding.start_day_latest or ""
        if finding.status not in _ALARMS or begin <= first or not ends & _moved_by(finding):
            continue
        named = finding.moved_sensor
        edge = f"{finding.parent_frame} or {finding.child_frame}"
        who = REASONS["since" if named else "since, unnamed"]
        first, why = begin, who.format(day=begin, sensor=named or edge)
    return first, why


def drift_per_day(
    sensor: Sensor, reference: Sensor, findings: Sequence[DriftFinding]
) -> Float[np.ndarray, " 6"] | None:
    """Rotation [rad] and shift [m] per day, each three times, of a slow drift found by the audit; else None."""
    rate = np.zeros(6)
    for finding in findings:
        drifts = finding.status in _ALARMS and finding.kind == "slow drift"
        if not drifts or not finding.start_day or not {sensor.name, reference.name} & _moved_by(finding):
            continue
        since = dt.date.fromisoformat(finding.start_day)
        days = max((dt.date.fromisoformat(finding.day) - since).days, 1)
        at = slice(0, 3) if finding.dof.startswith("r") else slice(3, 6)
        rate[at] = np.maximum(rate[at], abs(finding.magnitude or 0.0) / days)
    return rate if rate.any() else None


def _moved_by(finding: DriftFinding) -> set[str]:
    named = finding.moved_sensor
    return {finding.parent_frame, finding.child_frame} if named is None else {named}


def events_until(lake: Lake, last: str | None) -> dict[str, list[ServiceEvent]]:
    """Valid events by vehicle in order of day: the last version of each, without withdrawn or later ones."""
    events: dict[str, list[ServiceEvent]] = {}
    for event in current_events(read_records(lake, SERVICE_EVENTS, ServiceEvent, last=last)):
        events.setdefault(event.vehicle, []).append(event)
    return events


def restart_of(events: Sequence[ServiceEvent], edge: Edge, last_day: str) -> ServiceEvent | None:
    """The last event that moved an edge, or may have; None if there was none.

    The day of the event belongs to neither side, because the drive may be before or after it.
    """
    return _last_touching(events, {sensor.name for sensor in edge.sensors}, last_day)


def _last_touching(events: Sequence[ServiceEvent], names: set[str], last_day: str) -> ServiceEvent | None:
    touching = [e for e in events if e.day <= last_day and e.touches(names)]
    return max(touching, key=lambda e: e.day, default=None)
