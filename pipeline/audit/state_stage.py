"""Stage state: from calibrations and the audit's findings to the calibration to load tonight."""

from __future__ import annotations

import datetime as dt
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.audit.days import DOFS, charts_of_fleet, edges_of_fleet
from pipeline.audit.estimates import Estimates, days_of, estimates_of, joined
from pipeline.audit.fusion import LEAST_SCATTER, Mount
from pipeline.audit.history import History, models_of
from pipeline.audit.noise import estimate_noise
from pipeline.audit.pose_days import VehiclePoses, read_poses
from pipeline.audit.references import (
    Kept,
    events_until,
    first_accepted,
    kept_columns,
    kept_of,
    read_kept,
    restart_of,
)
from pipeline.audit.rig_states import rig_states
from pipeline.audit.vehicle import limit_of
from pipeline.audit.wander import with_wander
from pipeline.core.config import AuditConfig, FleetConfig, config_hash
from pipeline.core.stage_work import Run, Task, Told, Window, Work
from pipeline.rig.graph import Edge, edge_of, tie
from pipeline.store.partitions import content_hash, days_after, last_possible_day, work_key
from pipeline.store.records import last_day, read_last
from schemas.calibrations import CALIBRATIONS, DOF_NAMES
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import StateRow
from schemas.versions import CODE_VERSION

__all__ = ["work"]

# Days that a state looks back: beyond, its common part is nearly all of it, and seasons and tyres are others.
_DAYS_BACK = 60
_END = dt.date.max.toordinal()
# What is asked of the audit's rows.
_CHANGE = ("start_day", "start_day_latest", "moved_sensor", "kind", "magnitude")


def work(task: Task) -> Work:
    """State of every vehicle with a record in the window: a row per edge, and per sensor of an adjusted rig.

    The window ends as the audit's does.

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
    poses = read_poses(task.lake, method, first, last) if last else {}
    changes: dict[str, list[DriftFinding]] = {}
    for finding in read_last(task.lake, DRIFT, DriftFinding, method, columns=_CHANGE):
        changes.setdefault(finding.vehicle, []).append(finding)
    references = _references(history, records, (first, last), events, fleet.audit) if last else {}

    settings = (fleet.audit, fleet.verify, {"to": last, "method": method})

    def rows(run: Run) -> Generator[StateRow, None, None]:
        own_mounts, count = _mounts(poses, fleet), fleet.audit.reference_days
        for done, vehicle in enumerate(records.vehicles):
            run.progress(done, len(records.vehicles), vehicle)
            edges = _edges_of(records.of(vehicle))
            known = events.get(vehicle, ()), changes.get(vehicle, ())
            about, mounts = (vehicle, last, method), own_mounts.get(vehicle, {})
            whole = [
                row
                if row.sensor is not None
                else replace(row, **kept_columns(references[vehicle, edge_of(row)], count))
                for row in rig_states(about, poses.get(vehicle), edges, known, mounts, fleet.verify)
            ]
            inputs = sorted({key for row in whole for key in row.inputs})
            key = work_key("state", CODE_VERSION, config_hash(*settings), [*inputs, content_hash(whole)])
            yield from (replace(row, work_key=key) for row in whole)

    of_poses = {key for own in poses.values() for days in own.sensors.values() for key in days.work_keys}
    read = tuple(sorted({*records.keys(), *of_poses}))
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


def _edges_of(records: Estimates) -> dict[Edge, Float[np.ndarray, "3 3"] | None]:
    """Edges of a vehicle's records, with the targets of the last record that has them."""
    found: dict[Edge, Float[np.ndarray, "3 3"] | None] = {}
    for edge in records.own_edges():
        targets = records.targets[records.is_of(edge)]
        known = np.flatnonzero(np.isfinite(targets).all(axis=(1, 2)))
        found[edge] = targets[known[-1]] if len(known) else None
    return found


def _told(rows: Sequence[StateRow]) -> Told:
    counts = {s: sum(r.status == s for r in rows) for s in ("current", "prior", "none")}
    return Told(counts, reason="" if rows else "no calibration record", refused=not rows)


def _mounts(poses: Mapping[str, VehiclePoses], fleet: FleetConfig) -> dict[str, dict[Edge, Mount]]:
    """How the mounts of every vehicle move, by tie of sensor and reference."""
    days = [
        {tie(s, own.reference): d.charted() for s, d in own.sensors.items() if len(d.poses.day)}
        for own in poses.values()
    ]
    edges = edges_of_fleet(days)
    if not edges:
        return {}
    models, charts, shape = (
        models_of(fleet, poses),
        charts_of_fleet(days, edges),
        (len(days), len(edges), DOFS),
    )
    limit = np.tile([limit_of(edge, dof, fleet.audit) for edge in edges for dof in DOF_NAMES], len(days))
    noise = with_wander(charts, estimate_noise(charts, shape, models), limit, shape, models)
    least = noise.less_alike or noise
    # Days that scatter by more than their sigmas do so because the mount does, or because the sigmas are too small:
    # either way tomorrow lies that far off.
    sigma = np.where(np.isfinite(charts.sigma), charts.sigma, np.nan)
    known = charts.count > 0
    typical = np.zeros(len(known))
    typical[known] = np.nanmedian(sigma[known], axis=1)
    beyond = ((noise.scale**2 - 1) * typical**2).reshape(shape)
    alike = (0.5 * (noise.autocorrelation + least.autocorrelation)).reshape(shape).mean(axis=-1)
    wander = noise.wander.reshape(shape)
    return {
        vehicle: {
            edge: Mount(np.sqrt(LEAST_SCATTER**2 + beyond[v, p]), wander[v, p], float(alike[v, p]))
            for p, edge in enumerate(edges)
            if edge in own
        }
        for v, (vehicle, own) in enumerate(zip(poses, days, strict=True))
    }
