"""Fixed references in table states, so that a night need not read vehicles' first days again.

A stored reference is valid with the same service event and setting, unless a record of an older day became
current.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.audit.days import PairDays, Reference, reference_of
from pipeline.audit.estimates import day_name
from pipeline.audit.restarts import restart_of
from pipeline.rig.edges import edge_of
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import from_quaternion, to_quaternion
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_columns, read_latest
from schemas.calibrations import CALIBRATIONS
from schemas.columns import POSE_COLUMNS
from schemas.service_events import ServiceEvent
from schemas.states import STATES, StateRow

__all__ = ["Kept", "first_accepted", "kept_columns", "kept_of", "read_kept"]

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
