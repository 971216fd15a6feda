"""Stage audit: table calibrations to table drift, all vehicles of a fleet over a window of days.

Changes that nearly all vehicles of a model show on the same day (a release, or another common cause) are removed from
the days of the model's vehicles, which are judged again, so a vehicle that was also knocked on that day still shows a
change. A change of half of a model's vehicles is not removed, because no majority determines which half is right.
"""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pipeline.audit.days import FEWEST_DAYS, PairDays, Reference, charted, reference_of
from pipeline.audit.estimates import Estimates, day_name, days_of
from pipeline.audit.findings import vehicle_findings
from pipeline.audit.history import History, last_audited_day, models_of
from pipeline.audit.reasons import REASONS, because
from pipeline.audit.references import events_until, restart_of
from pipeline.audit.vehicle import VehicleVerdict, judge_fleet
from pipeline.core.config import AuditConfig, FleetConfig, config_hash
from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress
from pipeline.core.stage_work import Task, Told, Window, Work
from pipeline.rig.graph import KINDS, Edge, edge_between, edge_of
from pipeline.rig.kinds import EDGE_KINDS
from pipeline.store.partitions import Lake, check_day, content_hash, days_after, last_possible_day, work_key
from pipeline.store.records import read_last
from schemas.calibrations import CALIBRATIONS, DOF_NAMES
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import STATES
from schemas.versions import CODE_VERSION

__all__ = ["FleetShift", "judge_without_fleet_shifts", "work"]

# Columns read of an earlier audit's rows.
_OF_BEFORE = ("start_day", "start_day_earliest", "start_day_latest", "kind")
_NAMED = 5  # records that an outcome names where they were left out; the others it counts
# From least to most urgent.
_CALMEST_FIRST = ("GREEN", "UNKNOWN", "YELLOW", "RED")
_LESS, _KEPT = REASONS["damaged"], REASONS["kept"]


@dataclass(frozen=True)
class _Vehicle:
    """Input of the audit: valid records until the window's end, and service events."""

    records: Estimates
    events: Sequence[ServiceEvent]
    references: Mapping[Edge, Reference]  # that an earlier night made of records that are not among these
    said: Sequence[DriftFinding]  # by the last audit, where some of the vehicle's records cannot be read


def work(task: Task) -> Work:
    """Every vehicle's charts over the task's window, as findings that are added to table drift.

    The window ends with its last day (None = the last day with a record of any vehicle) and begins with its
    first (None = `audit.window_days` before its end). The configuration's vehicles are audited even if they
    have no record. There is one finding per vehicle, edge and DoF, in that order, and none if the lake has no
    record in the window. The outcome lists unusable records and records of future days, which are left out.

    Raises:
        ConfigError: a day is invalid, or the window is empty.
        ContractError: a record was written with another schema version.
    """
    assert isinstance(task.of, Window), "an audit looks at all vehicles"
    fleet, method = task.fleet, task.method or task.fleet.audit.method
    latest = max(last_possible_day(), task.of.last or "")
    first, last = _window(task, last_audited_day(task.lake, latest))
    history = History(task.lake, method, latest)
    history.read(days_after(latest, 1), None)  # days to come are named
    events = events_until(task.lake, last)
    enough = (FEWEST_DAYS, fleet.audit.reference_days)
    records, references = history.window((first, last), events, enough, fleet.named_vehicles)
    said = _said_before(task.lake, method)
    names = sorted({*records.vehicles, *fleet.named_vehicles, *said})
    vehicles = {
        name: _Vehicle(records.of(name), events.get(name, ()), references.get(name, {}), said.get(name, ()))
        for name in names
    }
    done = sorted([e.vehicle, e.day, e.sensor, e.kind] for v in vehicles.values() for e in v.events)
    settings = (fleet.audit, {"from": first, "to": last, "method": method, "events": done})
    return Work(
        settings,
        lambda run: _judged(task, vehicles, (first, last, method), run.progress),
        inputs=tuple(records.keys()),
        tell=lambda rows: _told(rows, list(history.left_out)),
        again=True,
    )


def _judged(
    task: Task, vehicles: Mapping[str, _Vehicle], window: tuple[str, str, str], progress: Progress
) -> Generator[DriftFinding, None, None]:
    """Findings of each vehicle, judged together."""
    fleet, (first, _, method) = task.fleet, window
    begin = _ordinal(first)
    if not any(v.said or (v.records.day >= begin).any() for v in vehicles.values()):
        return
    days = [_charted(vehicle, window, fleet.audit) for vehicle in vehicles.values()]
    models = models_of(fleet, vehicles)
    verdicts, shifts = judge_without_fleet_shifts(days, fleet.audit, models)
    before = _found_before(task.lake, method, dict(zip(vehicles, verdicts, strict=True)), first)
    for done, ((name, vehicle), verdict) in enumerate(zip(vehicles.items(), verdicts, strict=True)):
        progress(done, len(vehicles), name)
        known = shifts[models[done]], before.get(name, {})
        yield from _findings(fleet, name, vehicle, verdict, window, known)
    progress(len(vehicles), len(vehicles), "")


def _charted(vehicle: _Vehicle, window: tuple[str, str, str], config: AuditConfig) -> dict[Edge, PairDays]:
    """The window's days of each edge with its reference, since the last service event."""
    first, last = (_ordinal(day) for day in window[:2])
    charts = {}
    for edge, days in days_of(vehicle.records, config.held_sigma_factor).items():
        restart = restart_of(vehicle.events, edge, window[1])
        since = 0 if restart is None else _ordinal(restart.day) + 1
        own = days.between(since, last)
        reference = vehicle.references.get(edge) or reference_of(own, config.reference_days)
        charts[edge] = charted(own, first, last, reference)
    return charts


def _ordinal(day: str) -> int:
    return dt.date.fromisoformat(day).toordinal()


def _told(findings: Sequence[DriftFinding], left_out: Sequence[str]) -> Told:
    counts = Counter(f.status for f in findings)
    reasons = [] if findings else [REASONS["no records"]]
    if left_out:
        more = f" and {len(left_out) - _NAMED} more" if len(left_out) > _NAMED else ""
        reasons.append(because("left out", records="; ".join(left_out[:_NAMED]), more=more))
    rejected = {"unusable record": len(left_out)} if left_out else {}
    return Told(dict(counts), rejected, "; ".join(reasons), refused=not findings)


def _window(task: Task, audited: str | None) -> tuple[str, str]:
    """First and last day; `audited` is the last one that has a record."""
    assert isinstance(task.of, Window), "an audit looks at all vehicles"
    for name, day in (("from", task.of.first), ("to", task.of.last)):
        check_day(name, day)
    last = task.of.last or audited or "9999-12-31"
    days = task.fleet.audit.window_days
    first = task.of.first or days_after(last, 1 - days)
    if first > last:
        raise ConfigError("command line", "from", f"{first} is after the window's last day {last}")
    return first, last


def _findings(
    fleet: FleetConfig, name: str, vehicle: _Vehicle, verdict: VehicleVerdict, window: tuple[str, str, str],
    known: tuple[Mapping[tuple[Edge, str], FleetShift], Mapping[tuple[Edge, str], DriftFinding]],
) -> list[DriftFinding]:  # fmt: skip
    (first, last, method), (shifts, before) = window, known
    records = vehicle.records.at(np.flatnonzero(vehicle.records.day >= _ordinal(first)))
    inputs = records.keys()
    config = config_hash(fleet.audit, {"from": first, "to": last, "method": method})
    remarks = _remarks(vehicle, last, shifts)
    possible = () if len(records.edge) else _possible_edges(fleet, name)
    rows = vehicle_findings((name, last, method), records, verdict, fleet.audit, remarks, before, possible)
    rows = _standing(rows, vehicle.said, vehicle.events, last)
    # All vehicles are judged side by side, so a verdict rests on more than this vehicle's records: the key has it too.
    key = work_key("audit", CODE_VERSION, config, [*inputs, content_hash(rows)])
    return [replace(row, work_key=key) for row in rows]


def _possible_edges(fleet: FleetConfig, name: str) -> list[Edge]:
    """Edges that are UNKNOWN for a vehicle without records: those of its rig, in a large rig those at its reference."""
    rig = fleet.rig_of(name)
    if rig.named_edges is not None:
        return list(rig.named_edges)
    nodes = sorted(rig.nodes, key=lambda n: KINDS.index(n.kind))
    pairs = [(a, b) for a, b in combinations(nodes, 2) if f"{a.kind}_{b.kind}" in EDGE_KINDS]
    if len(nodes) > len(KINDS) - 1:
        middle = rig.reference or next(iter((*rig.lidars, *rig.sensors)))
        pairs = [(a, b) for a, b in pairs if middle in (a.name, b.name)]
    return [edge_between(a, b) for a, b in pairs]


def _found_before(
    lake: Lake, method: str, verdicts: Mapping[str, VehicleVerdict], first: str
) -> dict[str, dict[tuple[Edge, str], DriftFinding]]:
    """Rows of the last audit by vehicle, for changes that may have begun before the window."""
    window = _ordinal(first)
    asked = {
        name
        for name, verdict in verdicts.items()
        if any(c.change is not None and c.change.earliest < window for c in verdict.charts.values())
    }
    before: dict[str, dict[tuple[Edge, str], DriftFinding]] = {}
    if asked:
        for finding in read_last(lake, DRIFT, DriftFinding, method, vehicle=asked, columns=_OF_BEFORE):
            edge = edge_of(finding)
            before.setdefault(finding.vehicle, {})[edge, finding.dof] = finding
    return before


def _remarks(
    vehicle: _Vehicle, last: str, shifts: Mapping[tuple[Edge, str], FleetShift]
) -> dict[tuple[Edge, str], str]:
    """Remarks on a chart: its first day, and values left out."""
    remarks: dict[tuple[Edge, str], str] = {}
    for edge in vehicle.records.own_edges():
        restart = restart_of(vehicle.events, edge, last)
        if restart is not None:
            remarks |= {(edge, dof): because("since work", event=restart.in_words) for dof in DOF_NAMES}
    for key, shift in shifts.items():
        text = because("fleet", some=shift.vehicles, all=shift.of, day=day_name(shift.day))
        remarks[key] = f"{remarks[key]}; {text}" if key in remarks else text
    return remarks


def _said_before(lake: Lake, method: str) -> Mapping[str, list[DriftFinding]]:
    """Last audit's findings of vehicles whose records may be among the unreadable ones."""
    lost = [rows for rows in lake.lost if rows.table in (CALIBRATIONS.name, STATES.name)]
    said: dict[str, list[DriftFinding]] = {}
    for finding in read_last(lake, DRIFT, DriftFinding, method) if lost else ():
        if any(rows.may_be_of(finding.vehicle) for rows in lost):
            said.setdefault(finding.vehicle, []).append(finding)
    return said


def _standing(
    found: list[DriftFinding], said: Sequence[DriftFinding], events: Sequence[ServiceEvent], day: str
) -> list[DriftFinding]:
    """The valid findings of a vehicle tonight, with the reason: the last audit's if tonight's are less severe.

    `said` is empty if all of the vehicle's records could be read. Service events since the last audit end its
    findings.
    """
    if not said or any(event.recorded_at > said[0].asserted_at for event in events):
        return found
    again = [replace(row, day=day, recorded_at="", asserted_at="") for row in said]
    if not found:  # nothing of the vehicle can be read
        found = [
            replace(row, status="UNKNOWN", vehicle_status="UNKNOWN", reason=_LESS, vehicle_reason=_LESS)
            for row in again
        ]
    before, now = (_CALMEST_FIRST.index(rows[0].vehicle_status or "UNKNOWN") for rows in (said, found))
    alarmed = before >= _CALMEST_FIRST.index("YELLOW")
    if before < now or (before == now and not alarmed):
        kept = [
            row
            if _LESS in (row.vehicle_reason or "")
            else replace(row, vehicle_reason=f"{row.vehicle_reason}; {_LESS}")
            for row in found
        ]
    else:
        since = said[0].day
        kept = [
            replace(
                row, reason=_kept(row.reason, since), vehicle_reason=_kept(row.vehicle_reason or "", since)
            )
            for row in again
        ]
    # More days do not replace the records of an UNKNOWN vehicle that cannot be read.
    return [
        replace(row, vehicle_days_needed=None) if row.vehicle_status == "UNKNOWN" else row for row in kept
    ]


def _kept(reason: str, day: str) -> str:
    return reason if reason.startswith(_KEPT) else f"{_KEPT} (audit of {day}): {reason}"


# Fewer vehicles are no fleet: three knocked on one day may have met the same kerb.
_FEWEST_VEHICLES = 6
_ALARMS = 0.3  # share of the vehicles with days on both sides whose charts show the change
_SHARE = 0.8  # of them that lie nearer to the common change than to none
_DAYS_APART = 1  # of the days on which they show it: not all drive daily


@dataclass(frozen=True)
class FleetShift:
    """One chart of most vehicles changed on one day: first ordinal with the new value, median size [rad or m]."""

    day: int
    size: float
    vehicles: int
    of: int


def judge_without_fleet_shifts(
    fleet: Sequence[Mapping[Edge, PairDays]], config: AuditConfig, models: Sequence[str]
) -> tuple[list[VehicleVerdict], dict[str, dict[tuple[Edge, str], FleetShift]]]:
    """Verdicts on all vehicles, and the removed changes of each model by edge and DoF; `models` by vehicle."""
    verdicts = judge_fleet(fleet, config, models)
    shifts: dict[str, dict[tuple[Edge, str], FleetShift]] = {}
    for model in sorted(set(models)):
        rows = [v for v, name in enumerate(models) if name == model]
        shifts[model] = _shifts([fleet[v] for v in rows], [verdicts[v] for v in rows])
    if any(shifts.values()):
        without = [_without(pairs, shifts[name]) for name, pairs in zip(models, fleet, strict=True)]
        verdicts = judge_fleet(without, config, models)
    return verdicts, shifts


def _shifts(
    fleet: Sequence[Mapping[Edge, PairDays]], verdicts: Sequence[VehicleVerdict]
) -> dict[tuple[Edge, str], FleetShift]:
    found = {}
    for key in {k: None for v in verdicts for k, chart in v.charts.items() if chart.change is not None}:
        changes = [v.charts[key].change for v in verdicts if key in v.charts]
        starts = Counter((c.day, c.size > 0) for c in changes if c is not None and c.kind == "step")
        if not starts:
            continue
        day, up = max(starts, key=lambda start: (starts[start], start))
        vehicles = sum(n for (d, u), n in starts.items() if u == up and abs(d - day) <= _DAYS_APART)
        sizes = np.array([s for pairs in fleet if (s := _size(pairs, key, day)) is not None])
        if vehicles < max(_FEWEST_VEHICLES, _ALARMS * len(sizes)):
            continue
        size = float(np.median(sizes))
        alike = int((np.abs(sizes - size) < np.abs(sizes)).sum())
        if alike >= _SHARE * len(sizes):
            found[key] = FleetShift(day, size, alike, len(sizes))
    return found


def _size(pairs: Mapping[Edge, PairDays], key: tuple[Edge, str], day: int) -> float | None:
    """Median after minus median before, of one vehicle; None with fewer than two days on a side."""
    days = pairs.get(key[0])
    if days is None:
        return None
    k = DOF_NAMES.index(key[1])
    seen = days.observable[:, k]
    value, is_after = days.change[seen, k], days.day[seen] >= day
    enough = is_after.sum() > 1 and ((~is_after).sum() > 1 or days.reference_days > 0)
    if not enough or is_after.all():
        return None
    return float(np.median(value[is_after]) - np.median(value[~is_after]))


def _without(
    own: Mapping[Edge, PairDays], shifts: Mapping[tuple[Edge, str], FleetShift]
) -> dict[Edge, PairDays]:
    out = {}
    for edge, days in own.items():
        change = days.change.copy()
        for k, dof in enumerate(DOF_NAMES):
            shift = shifts.get((edge, dof))
            if shift is not None:
                change[days.day >= shift.day, k] -= shift.size
        out[edge] = replace(days, change=change)
    return out
