"""Stage state: calibrations, and what the audit said of them, to what each vehicle should load tonight."""

from __future__ import annotations

import datetime as dt
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from pipeline.audit.days import DOFS, charts_of_fleet, edges_of_fleet
from pipeline.audit.estimates import Estimates, day_name, days_of, estimates_of, joined
from pipeline.audit.history import History
from pipeline.audit.noise import estimate_noise
from pipeline.audit.references import Kept, first_accepted, kept_columns, kept_of, read_kept
from pipeline.audit.service import events_until, restart_of, what_was_done
from pipeline.audit.state import DayEstimate, State, fuse
from pipeline.config import AuditConfig, FleetConfig, VerifyConfig, config_hash
from pipeline.geometry.se3 import to_quaternion
from pipeline.geometry.target_sigmas import target_sigmas
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.rig.graph import Edge
from pipeline.store.partitions import Partition, content_hash, last_possible_day, work_key
from pipeline.store.records import last_day, read_last
from pipeline.work import Records, Run, Task, Told, Window, Work
from schemas.calibrations import CALIBRATIONS, DOF_NAMES
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import StateRow
from schemas.versions import CODE_VERSION

__all__ = ["work"]

# Days that a state looks back: beyond, its common part is nearly all of it, and seasons and tyres are others.
_DAYS_BACK = 60
# Of successive accepted days: the most that the charts' budget is proved for. A state promises no more than such days
# can give.
_AUTOCORRELATION = 0.6
_END = dt.date.max.toordinal()
_OFTEN = 0.5  # share of a state's days: one day in 300 lies that far from the prior by chance
_CHANGE = ("start_day", "start_day_latest")  # what is asked of the audit's rows


def work(task: Task) -> Work:
    """The state of every vehicle that has a record in the window, one row per edge.

    A state rests on the accepted days since the last of: the vehicle's first day, a service event, a change that the
    latest audit found. The window ends as the audit's does.

    Raises:
        ContractError: a record was written with another schema version.
    """
    assert isinstance(task.of, Window), "states are of all vehicles"
    fleet, method = task.fleet, task.method or task.fleet.audit.method
    last = task.of.last or min(last_day(task.lake, CALIBRATIONS) or "", last_possible_day())
    first = (dt.date.fromisoformat(last) - dt.timedelta(days=_DAYS_BACK - 1)).isoformat() if last else ""
    history = History(task.lake, method, last)
    records = history.read(first, last) if last else estimates_of(None)
    events = events_until(task.lake, last or None)
    changes: dict[str, list[DriftFinding]] = {}
    for finding in read_last(task.lake, DRIFT, DriftFinding, method, columns=_CHANGE):
        changes.setdefault(finding.vehicle, []).append(finding)
    references = _references(history, records, (first, last), events, fleet.audit) if last else {}

    def rows(run: Run) -> Generator[Records, None, None]:
        scales = _scales(records, fleet.audit)
        for done, vehicle in enumerate(records.vehicles):
            run.progress(done, len(records.vehicles), vehicle)
            of_vehicle = records.of(vehicle)
            edges = of_vehicle.own_edges()
            since = {e: _since(e, events.get(vehicle, ()), changes.get(vehicle, ()), last) for e in edges}
            own = _states(fleet, (vehicle, last, method), of_vehicle, since, scales[done])
            kept = [references[vehicle, edge] for edge in edges]
            count = fleet.audit.reference_days
            whole = [replace(r, **kept_columns(k, count)) for r, k in zip(own.rows, kept, strict=True)]
            begun = {edge.name: first for edge, first in since.items()}
            config = config_hash(fleet.audit, fleet.verify, {"to": last, "method": method, "since": begun})
            key = work_key("state", CODE_VERSION, config, [*(own.inputs or ()), content_hash(whole)])
            yield replace(own, rows=[replace(r, work_key=key) for r in whole], work_key=key)

    settings = (fleet.audit, fleet.verify, {"to": last, "method": method})
    return Work(settings, rows, inputs=tuple(records.keys()), tell=_told, again=True)


def _references(
    history: History,
    records: Estimates,
    window: tuple[str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    config: AuditConfig,
) -> dict[tuple[str, Edge], Kept]:
    """The fixed reference of every vehicle and edge, as far as there is one: kept, or made of its first days."""
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


def _scales(records: Estimates, config: AuditConfig) -> list[dict[Edge, Float[np.ndarray, " 6"]]]:
    """By vehicle, edge and DoF of a change, how much more its days scatter than they say, as the charts see it."""
    days = [days_of(records.of(vehicle), config.held_sigma_factor) for vehicle in records.vehicles]
    edges = edges_of_fleet(days)
    charts = charts_of_fleet([{e: own.at(own.accepted) for e, own in of.items()} for of in days], edges)
    scale = estimate_noise(charts, DOFS, len(edges)).scale if edges else np.ones(0)
    return [dict(zip(edges, s, strict=True)) for s in scale.reshape(len(days), len(edges), DOFS)]


def _since(
    edge: Edge, events: Sequence[ServiceEvent], findings: Sequence[DriftFinding], last: str
) -> tuple[str, str]:
    """First day that may count for an edge, and why; empty where all days may."""
    first, why = "", ""
    event = restart_of(events, edge, last)
    if event is not None:
        first = (dt.date.fromisoformat(event.day) + dt.timedelta(days=1)).isoformat()
        why = f"after the {what_was_done(event)}"
    for finding in findings:
        is_own = (finding.parent_frame, finding.child_frame) == (edge.parent.name, edge.child.name)
        changed = is_own and finding.status in ("RED", "YELLOW") and finding.start_day
        if changed and (finding.start_day_latest or "") > first:
            first = finding.start_day_latest or ""
            why = f"after a change that the audit found since {finding.start_day}"
    return first, why


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
        found = fuse(_days(own), scale=scales.get(edge), autocorrelation=_AUTOCORRELATION)
        words = _words(why, found)
        base = StateRow(
            vehicle=vehicle,
            day=last,
            method=method,
            pair=edge.kind,
            parent_frame=edge.parent.name,
            child_frame=edge.child.name,
            status="none",
            reason=words,
            since=first or None,
        )
        rows.append(base if found is None else _with_state(base, found, own, fleet.verify))
    return Records(rows, Partition(vehicle, last), inputs=inputs)


def _words(why: str, found: State | None) -> str:
    """Why the state rests on the days that it rests on."""
    if found is None:
        return f"no accepted day {why}".rstrip()
    left = f"left out, far from the others: {', '.join(found.left_out)}" if found.left_out else ""
    return "; ".join(text for text in (why, left) if text)


def _days(records: Estimates) -> list[DayEstimate]:
    """Accepted records of an edge as days to fuse."""
    return [
        DayEstimate(day_name(day), T, covariance, common if has_common else None, observable)
        for day, T, covariance, common, has_common, observable in zip(
            records.day.tolist(), records.transforms(), records.covariance, records.common,
            records.has_common.tolist(), records.observable, strict=True,
        )
    ]  # fmt: skip


def _with_state(base: StateRow, found: State, records: Estimates, verify: VerifyConfig) -> StateRow:
    own = records.at(np.flatnonzero([day_name(day) in found.days for day in records.day.tolist()]))
    sigma = target_sigmas(base.pair, found.T, found.covariance, _targets(own))
    azimuth, elevation = (
        (verify.camera_lidar_limit_deg, verify.camera_lidar_limit_deg)
        if "radar" not in base.pair
        else (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
    )
    reach = float(ndtri(0.5 + verify.confidence / 2)) * np.degrees(sigma)
    names = ("azimuth", "elevation")
    T, q = found.T, to_quaternion(found.T)
    return replace(
        base,
        status="current",
        qw=float(q[0]), qx=float(q[1]), qy=float(q[2]), qz=float(q[3]),
        tx_m=float(T[0, 3]), ty_m=float(T[1, 3]), tz_m=float(T[2, 3]),
        covariance=found.covariance,
        common_covariance=found.common,
        observable=[bool(v) for v in found.observable],
        determined=[n for n, r, limit in zip(names, reach, (azimuth, elevation), strict=True) if r <= limit],
        azimuth_sigma_rad=float(sigma[0]),
        elevation_sigma_rad=float(sigma[1]),
        days=list(found.days),
        unchecked=_unchecked(own),
        inputs=own.keys(),
    )  # fmt: skip


def _targets(days: Estimates) -> Float[np.ndarray, "N 3"]:
    """Where the sensors look, as the last of the days that says it has it."""
    known = np.flatnonzero(np.isfinite(days.targets).all(axis=(1, 2)))
    return days.targets[known[-1]] if len(known) else DEFAULT_TARGETS


def _unchecked(days: Estimates) -> dict[str, float]:
    """DoF that at least half of the days found far from the prior, with nothing to check them: the most sigmas."""
    often = np.mean(days.unchecked_sigmas > 0, axis=0) >= _OFTEN
    return {dof: float(days.unchecked_sigmas[:, k].max()) for k, dof in enumerate(DOF_NAMES) if often[k]}


def _told(rows: Sequence[StateRow]) -> Told:
    counts = {s: sum(r.status == s for r in rows) for s in ("current", "none")}
    return Told(counts, reason="" if rows else "no calibration record", refused=not rows)
