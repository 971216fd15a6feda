"""Stage audit: table calibrations to table drift, all vehicles of a fleet over a window of days."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Generator, Mapping, Sequence

from pipeline.audit.days import charted, reference_of
from pipeline.audit.estimates import days_of
from pipeline.audit.findings import VehicleAudit, vehicle_findings
from pipeline.audit.vehicle import VehicleVerdict, judge_fleet
from pipeline.config import FleetConfig, config_hash
from pipeline.errors import ConfigError
from pipeline.results import Progress
from pipeline.store.current import current_records
from pipeline.store.partitions import Partition, work_key
from pipeline.store.tables import read_records
from pipeline.work import Records, Task, Told, Window, Work
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
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
        if record.day <= last:
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
    first, last, method = window
    if not any(by_vehicle.values()):
        return
    config = fleet.audit
    vehicles = sorted(by_vehicle)
    ends = dt.date.fromisoformat(first).toordinal(), dt.date.fromisoformat(last).toordinal()
    days = []
    for vehicle in vehicles:
        found = days_of(by_vehicle[vehicle], config.held_sigma_factor)
        days.append({p: charted(d, *ends, reference_of(d, config.reference_days)) for p, d in found.items()})
    for done, (vehicle, verdict) in enumerate(zip(vehicles, judge_fleet(days, config), strict=True)):
        progress(done, len(vehicles), vehicle)
        yield _findings(fleet, vehicle, by_vehicle[vehicle], verdict, (first, last, method))
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
