"""Stage audit: table calibrations to table drift, all vehicles of a fleet over a window of days."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Generator, Mapping, Sequence

import numpy as np

from pipeline.audit.charts import Chart, pooled_scatter
from pipeline.audit.findings import VehicleAudit, vehicle_findings
from pipeline.audit.vehicle import PairDays, VehicleVerdict, charts_of, judge_vehicle
from pipeline.config import FleetConfig, config_hash
from pipeline.errors import ConfigError
from pipeline.results import Progress
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Partition, work_key
from pipeline.store.tables import read_records
from pipeline.work import Records, Task, Told, Window, Work
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.drift import DriftFinding
from schemas.versions import CODE_VERSION

__all__ = ["work"]


def work(task: Task) -> Work:
    """Every vehicle's charts over the task's window, as findings that are added to table drift.

    The window ends with its last day (None = the last day that any vehicle has a record for) and begins with its first
    (None = `audit.window_days` before its end). The configuration's vehicles are audited even where they have no
    record. One finding per vehicle, pair and DoF, in that order; none where the lake has no record in the window.

    Raises:
        ConfigError: a day is no day, or the window is empty.
        ContractError: a record was written with another schema version.
    """
    assert isinstance(task.of, Window), "an audit looks at all vehicles"
    fleet, method = task.fleet, task.method or task.fleet.audit.method
    records = current_records(
        [r for r in read_records(task.lake, CALIBRATIONS, CalibrationRecord) if r.method == method]
    )
    first, last = _window(records, task.of.first, task.of.last, fleet.audit.window_days)
    by_vehicle: dict[str, list[CalibrationRecord]] = {v: [] for v in fleet.vehicles}
    for record in records:
        if first <= record.day <= last:
            by_vehicle.setdefault(record.vehicle, []).append(record)
    settings = (fleet.audit, {"from": first, "to": last, "method": method})
    return Work(
        settings,
        lambda run: _judged(fleet, by_vehicle, (first, last, method), run.progress),
        inputs=tuple(sorted({r.work_key for rows in by_vehicle.values() for r in rows})),
        tell=_told,
        again=True,
    )


def _judged(
    fleet: FleetConfig,
    by_vehicle: Mapping[str, list[CalibrationRecord]],
    window: tuple[str, str, str],
    progress: Progress,
) -> Generator[Records, None, None]:
    """The findings of one vehicle after the other."""
    if not any(by_vehicle.values()):
        return
    factor = fleet.audit.held_sigma_factor
    days = {vehicle: _pairs(rows, factor) for vehicle, rows in by_vehicle.items()}
    scatter = _scatter(list(days.values()))
    for done, vehicle in enumerate(sorted(by_vehicle)):
        progress(done, len(by_vehicle), vehicle)
        verdict = judge_vehicle(days[vehicle], scatter, fleet.audit)
        yield _findings(fleet, vehicle, by_vehicle[vehicle], verdict, window)
    progress(len(by_vehicle), len(by_vehicle), "")


def _told(findings: Sequence[DriftFinding]) -> Told:
    counts = Counter(f.status for f in findings)
    reason = "" if findings else "no calibration record in the window"
    return Told(dict(counts), reason=reason, refused=not findings)


def _window(
    records: Sequence[CalibrationRecord], from_day: str | None, to_day: str | None, days: int
) -> tuple[str, str]:
    for name, day in (("from", from_day), ("to", to_day)):
        if day is not None:
            try:
                dt.date.fromisoformat(day)
            except ValueError as err:
                raise ConfigError("command line", name, f"{day!r} is no day of the form YYYY-MM-DD") from err
    last = to_day or max((r.day for r in records), default="9999-12-31")
    first = from_day or (dt.date.fromisoformat(last) - dt.timedelta(days=days - 1)).isoformat()
    if first > last:
        raise ConfigError("command line", "from", f"{first} lies after the window's last day {last}")
    return first, last


def _pairs(records: Sequence[CalibrationRecord], held_sigma_factor: float) -> dict[str, PairDays]:
    """Estimates by pair, with larger sigmas where the day was held; refused and disproved days are gaps."""
    pairs = {}
    for pair in PAIRS:
        rows = [r for r in records if r.pair == pair and _may_be_right(r)]
        transforms = [transform_of(r) for r in rows]
        if rows:
            factor = np.array([1.0 if r.status == "accepted" else held_sigma_factor for r in rows])
            covariance = np.stack([r.covariance for r in rows if r.covariance is not None])
            pairs[pair] = PairDays(
                np.array([dt.date.fromisoformat(r.day).toordinal() for r in rows]),
                np.stack([T for T in transforms if T is not None]),
                covariance * factor[:, None, None] ** 2,
                np.array([r.observable or [True] * 6 for r in rows], dtype=bool),
                np.array([r.status == "accepted" for r in rows], dtype=bool),
            )
    return pairs


def _may_be_right(record: CalibrationRecord) -> bool:
    """Whether a record has a pose that no check disproved: a lost basin is 0.7 m off at a sigma of millimetres."""
    return (
        record.status != "refused"
        and record.covariance is not None
        and not record.diagnostics.get("disproved", 0.0)
    )


def _scatter(fleet_days: Sequence[dict[str, PairDays]]) -> dict[tuple[str, str], float]:
    charts: dict[tuple[str, str], list[Chart]] = {}
    for pairs in fleet_days:
        for pair, pair_days in pairs.items():
            for dof, chart in charts_of(pair_days).items():
                charts.setdefault((pair, dof), []).append(chart)
    return {key: pooled_scatter(found) for key, found in charts.items()}


def _findings(
    fleet: FleetConfig,
    vehicle: str,
    records: Sequence[CalibrationRecord],
    verdict: VehicleVerdict,
    window: tuple[str, str, str],
) -> Records:
    first, last, method = window
    inputs = sorted({r.work_key for r in records})
    config = config_hash(fleet.audit, {"from": first, "to": last, "method": method})
    key = work_key("audit", CODE_VERSION, config, inputs)
    audit = VehicleAudit(vehicle, last, method, key, inputs)
    return Records(
        vehicle_findings(audit, records, verdict, fleet.audit), Partition(vehicle, last), key, inputs
    )
