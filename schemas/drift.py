"""Table `drift`: control charts per vehicle, edge and DoF. Append-only, a row per chart and audit.

Every row of a vehicle repeats the audit's verdict on the whole vehicle (`vehicle_*`). Pages and commands read
it there and do not compute another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

from schemas.columns import Recorded, TableSchema, column, row
from schemas.words import NEXT_STEPS, VEHICLE_WORDS, listed

__all__ = ["DRIFT", "DRIFT_STATUSES", "DriftFinding", "VehicleStatus", "next_step", "status_of"]

# Most urgent first; lists of vehicles are in this order.
DRIFT_STATUSES = tuple(VEHICLE_WORDS)


@row(eq=True)
class DriftFinding(Recorded):
    """One row of `drift`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("last day of the audited window, YYYY-MM-DD")
    method: str = column("method of the audited records")
    pair: str = column("kind of the edge: kinds of its two sensors, e.g. camera_lidar")
    parent_frame: str = column("parent of the edge: name of a sensor, or base")
    child_frame: str = column("child of the edge: name of a sensor, or base")
    dof: str = column("rx, ry, rz, tx, ty, tz in parent axes")
    status: str = column(
        "status of this chart: GREEN, YELLOW (a change below the limit, or not yet certain), RED, UNKNOWN "
        "(too little data); vehicle_status is the status of the vehicle"
    )
    reason: str = column("reason for the status")
    days_used: int = column("number of days on the chart")
    days_needed: int | None = column(
        "minimum of further accepted days until this chart has a verdict; null if it has one", default=None
    )
    statistic: float | None = column("maximum of the alarm statistic", default=None)
    threshold: float | None = column("alarm threshold for the false-alarm budget", default=None)
    start_day: str | None = column("first day after the change", default=None)
    start_day_earliest: str | None = column("lower end of the interval for start_day", default=None)
    start_day_latest: str | None = column("upper end of the interval for start_day", default=None)
    kind: str | None = column("'step' or 'slow drift'", default=None)
    magnitude: float | None = column("size of the change [rad or m]", default=None)
    magnitude_sigma: float | None = column("its sigma", default=None)
    limit: float = column("size of a change that matters for this kind of edge and DoF [rad or m]")
    moved_sensor: str | None = column(
        "name of the sensor whose motion explains the changes of all edges", default=None
    )
    moved_probability: float | None = column(
        "probability that moved_sensor moved and not another, 0..1; null if none moved", default=None
    )
    moved_motion: list[float] | None = column(
        "rotation vector [rad] and shift [m] of the moved sensor, in the axes of that sensor", default=None
    )
    moved_motion_sigma: list[float] | None = column("sigmas of moved_motion", default=None)
    inputs: list[str] = column("work keys of the records on the chart", default_factory=list)
    vehicle_status: str = column(
        f"status of the whole vehicle, equal in all its rows of one audit: {listed(VEHICLE_WORDS)}",
        default="UNKNOWN",
    )
    vehicle_sensor: str | None = column(
        "name of the sensor that moved; null if none moved or the data do not identify it", default=None
    )
    vehicle_since: str | None = column("first day after the vehicle's clearest change", default=None)
    vehicle_reason: str | None = column("reason for the vehicle's status", default=None)
    vehicle_days_needed: int | None = column(
        "minimum of further accepted days until the vehicle's status may change; null if days do not change it (if "
        "UNKNOWN: records cannot be read)",
        default=None,
    )


DRIFT = TableSchema(
    DriftFinding,
    "drift",
    6,
    made_by="audit",
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame", "dof"),
)


@dataclass(frozen=True)
class VehicleStatus:
    """Verdict of the audit on one vehicle: columns `vehicle_*` of its rows."""

    status: str
    reason: str
    sensor: str | None = None
    since: str | None = None
    days_needed: int | None = None


def status_of(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """The stored verdict on a vehicle, from its current rows of one method; UNKNOWN without an audit."""
    if not findings:
        return VehicleStatus("UNKNOWN", "no audit yet")
    first = findings[0]
    return VehicleStatus(
        first.vehicle_status,
        first.vehicle_reason or "",
        first.vehicle_sensor,
        first.vehicle_since,
        first.vehicle_days_needed,
    )


_WITHIN_REACH = 28  # days: the audit's window, four weeks by default, never has more


def next_step(findings: Sequence[DriftFinding], lake: str) -> str:
    """Next action for a vehicle that is not GREEN, with commands that run as printed; empty if none is needed.

    Args:
        findings: current rows of one vehicle and method.
        lake: folder or URL of the tables.
    """
    stored = status_of(findings)
    if not findings or stored.status == "GREEN":
        return ""
    vehicle, day, days = findings[0].vehicle, findings[0].day, stored.days_needed
    step, kind, done = stored.status, "repair", day
    if stored.status == "UNKNOWN":
        step += ", tables" if days is None else ", many days" if days > _WITHIN_REACH else ", days"
    elif stored.status == "YELLOW":
        step, kind, done = "YELLOW, days" if days else step, "re-mount", stored.since or day
    of = f"--lake {quote(lake)} --vehicle {quote(vehicle)}"
    what, sensor = (
        ("all sensors", "all") if not stored.sensor else (f"the {stored.sensor}", quote(stored.sensor))
    )
    service = f"`boresight service {of} --day {done} --kind {kind} --sensor {sensor}`"
    more = "1 more day is" if days == 1 else f"{days} more days are"
    tables = {"lake": quote(lake), "out": quote(f"tonight/{vehicle}"), "of": of}
    words = NEXT_STEPS[step].format(what=what, service=service, day=done, days=more, number=days, **tables)
    return f"{vehicle}: {words}"
