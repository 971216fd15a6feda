"""Stage state: from calibrations and the audit's findings to the calibration to load tonight."""

from __future__ import annotations

import datetime as dt
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.audit.days import DOFS, charts_of_fleet, edges_of_fleet
from pipeline.audit.estimates import Estimates, days_of, estimates_of, joined
from pipeline.audit.history import History, models_of
from pipeline.audit.noise import estimate_noise
from pipeline.audit.pose_states import pose_states, read_poses
from pipeline.audit.references import Kept, first_accepted, kept_columns, kept_of, read_kept
from pipeline.audit.service import events_until, restart_of, since_of
from pipeline.audit.state_rows import fused, with_state
from pipeline.config import AuditConfig, FleetConfig, config_hash
from pipeline.rig.graph import Edge
from pipeline.stage_work import Records, Run, Task, Told, Window, Work
from pipeline.store.partitions import Partition, content_hash, days_after, last_possible_day, work_key
from pipeline.store.records import last_day, read_last
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import StateRow
from schemas.versions import CODE_VERSION

__all__ = ["work"]

# Days that a state looks back: beyond, its common part is nearly all of it, and seasons and tyres are others.
_DAYS_BACK = 60
_END = dt.date.max.toordinal()
_CHANGE = ("start_day", "start_day_latest", "moved_sensor")  # what is asked of the audit's rows


def work(task: Task) -> Work:
    """State of every vehicle with a record in the window: a row per edge, and per sensor of an adjusted rig.

    A state is the mean of the accepted days since the last of: the vehicle's first day, a service event, a
    change found by the latest audit. The window ends as the audit's does.

    Raises:
        ContractError: a record was written with another schema version.
    """
    assert isinstance(task.of, Window), "states are of all vehicles"
    fleet, method = task.fleet, task.method or task.fleet.audit.method
    last = task.of.last or min(last_day(task.lake, CALIBRATIONS) or "", last_possible_day())
    first = days_after(last, 1 - _DAYS_BACK) if last else ""
    history = History(task.lake, method, last)
    records = history.read(first, last) if last else estimates_of(None)
    events = events_until(task.lake, last or None)
    poses = read_poses(task.lake, method, first, last)
    changes: dict[str, list[DriftFinding]] = {}
    for finding in read_last(task.lake, DRIFT, DriftFinding, method, columns=_CHANGE):
        changes.setdefault(finding.vehicle, []).append(finding)
    references = _references(history, records, (first, last), events, fleet.audit) if last else {}

    def rows(run: Run) -> Generator[Records, None, None]:
        scales, of_poses = _scales(records, fleet), _scales(poses.estimates, fleet)
        own_scales = dict(zip(poses.estimates.vehicles, of_poses, strict=True))
        for done, vehicle in enumerate(records.vehicles):
            run.progress(done, len(records.vehicles), vehicle)
            of_vehicle = records.of(vehicle)
            edges = of_vehicle.own_edges()
            since = {e: since_of(e, events.get(vehicle, ()), changes.get(vehicle, ()), last) for e in edges}
            own = _states(fleet, (vehicle, last, method), of_vehicle, since, scales[done])
            kept = [references[vehicle, edge] for edge in edges]
            count = fleet.audit.reference_days
            whole = [replace(r, **kept_columns(k, count)) for r, k in zip(own.rows, kept, strict=True)]
            known = events.get(vehicle, ()), changes.get(vehicle, ())
            about = vehicle, last, method
            whole += pose_states(about, poses, known, own_scales.get(vehicle, {}), fleet.verify)
            begun = {edge.name: first for edge, first in since.items()}
            config = config_hash(fleet.audit, fleet.verify, {"to": last, "method": method, "since": begun})
            inputs = sorted({*(own.inputs or ()), *(key for row in whole for key in row.inputs)})
            key = work_key("state", CODE_VERSION, config, [*inputs, content_hash(whole)])
            yield replace(own, rows=[replace(r, work_key=key) for r in whole], work_key=key, inputs=inputs)

    settings = (fleet.audit, fleet.verify, {"to": last, "method": method})
    read = tuple(sorted({*records.keys(), *poses.estimates.keys()}))
    return Work(settings, rows, inputs=read, tell=_told, again=True)


def _references(
    history: History,
    records: Estimates,
    window: tuple[str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    config: AuditConfig,
) -> dict[tuple[str, Edge], Kept]:
    """The fixed reference of every vehicle and edge: stored, or computed from its first days."""
    first, last = window
    count = config.reference_days
    kept = read_kept(history.lake, history.method, window, events, count)
    found = {key: own for key, own in kept.items() if own.reference is not None}
    asked = {(v, e) for v in records.vehicles for e in records.of(v).own_edges()} - found.keys()
    begin = dict.fromkeys(records.vehicles, first)
    lacking = {key: first_accepted(kept.get(key)) for key in asked}
    known = joined([records, *history.references(begin, window, events, count, lacking)])
    for vehicle in sorted({v for v, _ in asked}):
        days = days_of(known.of(vehicle), config.held_sigma_factor)
        for edge in (e for v, e in asked if v == vehicle):
            event = restart_of(events.get(vehicle, ()), edge, last)
            since = "" if event is None else event.day
            begun = dt.date.fromisoformat(since).toordinal() + 1 if since else 0
            own = days[edge].between(begun, _END) if edge in days else None
            found[vehicle, edge] = kept_of(own, since, count)
    return found


def _scales(records: Estimates, fleet: FleetConfig) -> list[dict[Edge, Float[np.ndarray, " 6"]]]:
    """Ratio of the days' scatter to their sigmas by vehicle, edge and DoF, from the charts."""
    held = fleet.audit.held_sigma_factor
    days = [days_of(records.of(vehicle), held) for vehicle in records.vehicles]
    edges = edges_of_fleet(days)
    charts = charts_of_fleet([{e: own.at(own.accepted) for e, own in of.items()} for of in days], edges)
    models = models_of(fleet, records.vehicles)
    scale = estimate_noise(charts, DOFS, len(edges), models).scale if edges else np.ones(0)
    return [dict(zip(edges, s, strict=True)) for s in scale.reshape(len(days), len(edges), DOFS)]


def _states(
    fleet: FleetConfig,
    about: tuple[str, str, str],
    records: Estimates,
    since: Mapping[Edge, tuple[str, str]],
    scales: Mapping[Edge, Float[np.ndarray, " 6"]],
) -> Records:
    vehicle, last, method = about
    inputs = records.keys()
    rows = []
    for edge, (first, why) in since.items():
        begin = dt.date.fromisoformat(first).toordinal() if first else 0
        usable = records.accepted & records.has_estimate & (records.day >= begin)
        own = records.at(np.flatnonzero(usable & records.is_of(edge)))
        found = fused(own, scales.get(edge))
        base = StateRow(
            vehicle=vehicle,
            day=last,
            method=method,
            pair=edge.kind,
            parent_frame=edge.parent.name,
            child_frame=edge.child.name,
            status="none",
            reason=f"no accepted day {why}".rstrip() if found is None else why,
            since=first or None,
        )
        if found is not None:
            base = with_state(base, found, own, (edge.kind, found.T, found.covariance), fleet.verify)
        rows.append(base)
    return Records(rows, Partition(vehicle, last), inputs=inputs)


def _told(rows: Sequence[StateRow]) -> Told:
    counts = {s: sum(r.status == s for r in rows) for s in ("current", "none")}
    return Told(counts, reason="" if rows else "no calibration record", refused=not rows)
