"""Status of each vehicle as stored by the audit, and sensors that moved, for printing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from shlex import quote
from types import MappingProxyType
from typing import Any

from rich.markup import escape

from jobs.terminal.record_tables import STATUS_STYLES
from pipeline.core.errors import ConfigError
from pipeline.store.corrections import correction_steps
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT_STATUSES, DriftFinding, VehicleStatus, next_step, status_of
from schemas.outcomes import OUTCOMES
from schemas.states import STATES

__all__ = ["count_statuses", "moved_sensors", "next_steps", "require_vehicle", "status_lines", "told_of"]

_NONE: Mapping[str, str] = MappingProxyType({})
_STEPS = 40  # vehicles whose next steps are printed; the others are counted


def status_lines(findings: Sequence[DriftFinding]) -> list[str]:
    """A line per vehicle, sorted by name: its status and the reason, in rich's markup."""
    return [
        f"[{STATUS_STYLES[stored.status]}]{stored.status:8}[/] {escape(vehicle)}  {escape(stored.reason)}"
        for vehicle, stored in _statuses(findings).items()
    ]


def count_statuses(findings: Sequence[DriftFinding]) -> dict[str, int]:
    """Number of vehicles by status, the most urgent status first."""
    found = [stored.status for stored in _statuses(findings).values()]
    return {status: found.count(status) for status in DRIFT_STATUSES}


def moved_sensors(findings: Sequence[DriftFinding]) -> list[dict[str, Any]]:
    """Sensors that moved, with vehicle and first day of the change."""
    return [
        {"vehicle": vehicle, "sensor": stored.sensor, "since": stored.since}
        for vehicle, stored in _statuses(findings).items()
        if stored.sensor
    ]


def told_of(findings: Sequence[DriftFinding]) -> dict[str, Any]:
    """What every summary after an audit has of the vehicles."""
    return {"statuses": count_statuses(findings), "moved": moved_sensors(findings)}


def next_steps(
    findings: Sequence[DriftFinding],
    lake: str,
    mend: Mapping[str, str] = _NONE,
    unaudited: Mapping[str, str] = _NONE,
) -> list[str]:
    """A sentence with the next command for each vehicle that is not GREEN, the most urgent first.

    Before them what `mend` has: corrections by vehicle, which no further day of an UNKNOWN one replaces.
    `unaudited`: steps of vehicles whose status is older than their last service event.
    """
    first = correction_steps(mend)
    rows = _by_vehicle(findings)
    status = {vehicle: status_of(own).status for vehicle, own in rows.items()}
    waiting = {vehicle for vehicle in mend if status.get(vehicle) == "UNKNOWN"}
    urgent = sorted(rows.keys() - waiting, key=lambda v: (DRIFT_STATUSES.index(status[v]), v))
    steps = [step for vehicle in urgent if (step := unaudited.get(vehicle) or next_step(rows[vehicle], lake))]
    left = len(steps) - _STEPS
    more = [f"and {left} other vehicles: `boresight status --lake {quote(lake)} --vehicle VEHICLE`"]
    return first[:_STEPS] + steps[:_STEPS] + more * (left > 0)


def _statuses(findings: Sequence[DriftFinding]) -> dict[str, VehicleStatus]:
    rows = _by_vehicle(findings)
    return {vehicle: status_of(rows[vehicle]) for vehicle in sorted(rows)}


def _by_vehicle(findings: Sequence[DriftFinding]) -> dict[str, list[DriftFinding]]:
    rows: dict[str, list[DriftFinding]] = {}
    for finding in findings:
        rows.setdefault(finding.vehicle, []).append(finding)
    return rows


_NAMED = 5  # vehicles of the lake named beside an unknown one


def require_vehicle(lake: Lake, vehicle: str) -> None:
    """Raise ConfigError for a vehicle without a day in the lake, unless rows that cannot be read may have one."""
    known: set[str] = set()
    for table in (CALIBRATIONS, OUTCOMES, STATES):
        rows = read_columns(lake, table, (), first=None, last=None)
        known |= set() if rows is None else set(rows["vehicle"].unique().to_pylist())
    if vehicle not in known and not any(rows.may_be_of(vehicle) for rows in lake.lost):
        like = get_close_matches(vehicle, sorted(known)) or sorted(known)[:_NAMED]
        problem = f"the lake has no day of {vehicle!r}; it has {', '.join(like) or 'no vehicle'}"
        raise ConfigError("command line", "vehicle", problem)
