"""Stage state: calibrations, and what the audit said of them, to what each vehicle should load tonight."""

from __future__ import annotations

import datetime as dt
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from pipeline.audit.days import DOFS, charts_of_fleet
from pipeline.audit.estimates import Estimates, day_name, days_of, estimates_of, joined
from pipeline.audit.history import History
from pipeline.audit.noise import estimate_noise
from pipeline.audit.references import Kept, first_accepted, kept_columns, kept_of, read_kept
from pipeline.audit.service import events_until, restart_of, what_was_done
from pipeline.audit.state import DayEstimate, State, fuse
from pipeline.config import AuditConfig, FleetConfig, VerifyConfig, config_hash
from pipeline.geometry.se3 import to_quaternion
from pipeline.geometry.target_sigmas import target_sigmas
from pipeline.store.partitions import Partition, content_hash, last_possible_day, work_key
from pipeline.store.records import last_day, read_last
from pipeline.work import Records, Run, Task, Told, Window, Work
from schemas.calibrations import CALIBRATIONS, DOF_NAMES, FRAMES_OF_PAIR, PAIRS
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
    """The state of every vehicle that has a record in the window, one row per pair.

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
        scales = _scales(records, fleet.audit) if records.vehicles else np.ones((0, 0, 0))
        for done, vehicle in enumerate(records.vehicles):
            run.progress(done, len(records.vehicles), vehicle)
            since = {p: _since(p, events.get(vehicle, ()), changes.get(vehicle, ()), last) for p in PAIRS}
            own = _states(fleet, (vehicle, last, method), records.of(vehicle), since, scales[done])
            kept = [references[vehicle, PAIRS.index(row.pair)] for row in own.rows]
            count = fleet.audit.reference_days
            whole = [replace(r, **kept_columns(k, count)) for r, k in zip(own.rows, kept, strict=True)]
            config = config_hash(fleet.audit, fleet.verify, {"to": last, "method": method, "since": since})
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
) -> dict[tuple[str, int], Kept]:
    """The fixed reference of every vehicle and pair, as far as there is one: kept, or made of its first days."""
    first, last = window
    count = config.reference_days
    kept = read_kept(history.lake, history.method, window, events, count)
    found = {key: own for key, own in kept.items() if own.reference is not None}
    asked = {(v, p) for v in records.vehicles for p in range(len(PAIRS))} - found.keys()
    begin = dict.fromkeys(records.vehicles, first)
    lacking = {key: first_accepted(kept.get(key)) for key in asked}
    known = joined([records, *history.references(begin, window, events, count, lacking)])
    for vehicle in sorted({v for v, _ in asked}):
        days = days_of(known.of(vehicle), config.held_sigma_factor)
        for place, pair in enumerate(PAIRS):
            if (vehicle, place) in asked:
                event = restart_of(events.get(vehicle, ()), pair, last)
                since = "" if event is None else event.day
                begun = dt.date.fromisoformat(since).toordinal() + 1 if since else 0
                own = days[pair].between(begun, _END) if pair in days else None
                found[vehicle, place] = kept_of(own, since, count)
    return found


def _scales(records: Estimates, config: AuditConfig) -> Float[np.ndarray, "V P 6"]:
    """By vehicle, pair and DoF of a change, how much more its days scatter than they say, as the charts see it."""
    days = [days_of(records.of(vehicle), config.held_sigma_factor) for vehicle in records.vehicles]
    charts = charts_of_fleet([{pair: own.at(own.accepted) for pair, own in of.items()} for of in days])
    return estimate_noise(charts, DOFS, len(PAIRS)).scale.reshape(len(days), len(PAIRS), DOFS)


def _since(
    pair: str, events: Sequence[ServiceEvent], findings: Sequence[DriftFinding], last: str
) -> tuple[str, str]:
    """First day that may count for a pair, and why; empty where all days may."""
    first, why = "", ""
    event = restart_of(events, pair, last)
    if event is not None:
        first = (dt.date.fromisoformat(event.day) + dt.timedelta(days=1)).isoformat()
        why = f"after the {what_was_done(event)}"
    for finding in findings:
        changed = finding.pair == pair and finding.status in ("RED", "YELLOW") and finding.start_day
        if changed and (finding.start_day_latest or "") > first:
            first = finding.start_day_latest or ""
            why = f"after a change that the audit found since {finding.start_day}"
    return first, why


def _states(
    fleet: FleetConfig,
    about: tuple[str, str, str],
    records: Estimates,
    since: Mapping[str, tuple[str, str]],
    scales: Float[np.ndarray, "P 6"],
) -> Records:
    vehicle, last, method = about
    inputs = records.keys()
    rows = []
    for pair, scale in zip(PAIRS, scales, strict=True):
        if not np.any(records.pair == PAIRS.index(pair)):
            continue  # the rig has it not
        first, why = since[pair]
        begin = dt.date.fromisoformat(first).toordinal() if first else 0
        usable = records.accepted & records.has_estimate & (records.day >= begin)
        own = records.at(np.flatnonzero(usable & (records.pair == PAIRS.index(pair))))
        found = fuse(_days(own), scale=scale, autocorrelation=_AUTOCORRELATION)
        parent, child = FRAMES_OF_PAIR[pair]
        words = _words(why, found)
        base = StateRow(
            vehicle=vehicle,
            day=last,
            method=method,
            pair=pair,
            parent_frame=parent,
            child_frame=child,
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
    """Accepted records of a pair as days to fuse."""
    return [
        DayEstimate(day_name(day), T, covariance, common if has_common else None, observable)
        for day, T, covariance, common, has_common, observable in zip(
            records.day.tolist(), records.transforms(), records.covariance, records.common,
            records.has_common.tolist(), records.observable, strict=True,
        )
    ]  # fmt: skip


def _with_state(base: StateRow, found: State, records: Estimates, verify: VerifyConfig) -> StateRow:
    sigma = target_sigmas(base.pair, found.T, found.covariance)
    azimuth, elevation = (
        (verify.camera_lidar_limit_deg, verify.camera_lidar_limit_deg)
        if base.pair == "camera_lidar"
        else (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
    )
    reach = float(ndtri(0.5 + verify.confidence / 2)) * np.degrees(sigma)
    names = ("azimuth", "elevation")
    T, q = found.T, to_quaternion(found.T)
    own = records.at(np.flatnonzero([day_name(day) in found.days for day in records.day.tolist()]))
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


def _unchecked(days: Estimates) -> dict[str, float]:
    """DoF that at least half of the days found far from the prior, with nothing to check them: the most sigmas."""
    often = np.mean(days.unchecked_sigmas > 0, axis=0) >= _OFTEN
    return {dof: float(days.unchecked_sigmas[:, k].max()) for k, dof in enumerate(DOF_NAMES) if often[k]}


def _told(rows: Sequence[StateRow]) -> Told:
    counts = {s: sum(r.status == s for r in rows) for s in ("current", "none")}
    return Told(counts, reason="" if rows else "no calibration record", refused=not rows)
