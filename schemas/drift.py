"""Table `drift`: control charts per vehicle, edge and DoF. Append-only, a row per chart and audit.

Every row of a vehicle repeats the audit's verdict on the whole vehicle (`vehicle_*`). Pages and commands read
it there and do not compute another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

from schemas.calibrations import FRAMES_OF_PAIR
from schemas.columns import Recorded, TableSchema, column, row

__all__ = [
    "DAYS_WILL_TELL",
    "DRIFT",
    "DRIFT_STATUSES",
    "DriftFinding",
    "VehicleStatus",
    "kind_of_sensor",
    "next_step",
    "status_of",
]

# Most urgent first; lists of vehicles are in this order.
DRIFT_STATUSES = ("RED", "YELLOW", "UNKNOWN", "GREEN")


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
    vehicle_status: str | None = column(
        "status of the whole vehicle, equal in all its rows of one audit: RED or YELLOW if a chart is, "
        "GREEN if a rotation of any sensor would have been detected, else UNKNOWN; null in rows of releases before 0.4",
        default=None,
    )
    vehicle_sensor: str | None = column(
        "name of the sensor that moved; null if none moved or the data do not identify it",
        default=None,
    )
    vehicle_since: str | None = column("first day after the vehicle's clearest change", default=None)
    vehicle_reason: str | None = column("reason for the vehicle's status", default=None)


DRIFT = TableSchema(
    DriftFinding,
    "drift",
    3,
    made_by="audit",
    reads_versions=(1, 2),
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame", "dof"),
    follows={
        name: ("pair", {pair: frames[k] for pair, frames in FRAMES_OF_PAIR.items()})
        for k, name in enumerate(("parent_frame", "child_frame"))
    },
)


@dataclass(frozen=True)
class VehicleStatus:
    """Verdict of the audit on one vehicle: columns `vehicle_*` of its rows."""

    status: str
    reason: str
    sensor: str | None = None
    since: str | None = None


def status_of(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """The stored verdict on a vehicle; UNKNOWN, with a reason, if no audit has stored one.

    Args:
        findings: current rows of one vehicle and method.
    """
    if not findings:
        return VehicleStatus("UNKNOWN", "no audit yet")
    first = findings[0]
    if first.vehicle_status is None:
        return VehicleStatus("UNKNOWN", "audited by an older release, which stored no status: audit again")
    return VehicleStatus(
        first.vehicle_status, first.vehicle_reason or "", first.vehicle_sensor, first.vehicle_since
    )


def kind_of_sensor(name: str, findings: Sequence[DriftFinding]) -> str:
    """Kind of a sensor (camera, lidar, radar or base), from the edges in findings.

    Args:
        name: name of the sensor.
        findings: findings of its vehicle.
    """
    known = {
        frame: kind
        for f in findings
        for frame, kind in zip((f.parent_frame, f.child_frame), f.pair.split("_"), strict=True)
    }
    return known.get(name, name)


# Ends of reasons that resolve themselves with more days: no action is needed yet.
DAYS_WILL_TELL = "will tell"


def next_step(vehicle: str, stored: VehicleStatus, lake: str = "LAKE") -> str:
    """Next action for a vehicle that is RED or YELLOW, with the command; empty if no action is needed."""
    if stored.status not in ("RED", "YELLOW"):
        return ""
    of = f"--lake {quote(lake)} --vehicle {quote(vehicle)}"
    sensor = stored.sensor or "all"
    load = f"load the state of tonight, which rests on the days since: `boresight export FORMAT {of} --out FOLDER`"
    if stored.status == "RED":
        what = f"how the {stored.sensor} is mounted" if stored.sensor else "how all sensors are mounted"
        service = f"`boresight service {of} --day YYYY-MM-DD --kind repair --sensor {sensor}`"
        return (
            f"{vehicle}: inspect {what}; when it is mended, run {service} with that day. Until then {load}."
        )
    if DAYS_WILL_TELL in stored.reason:
        return f"{vehicle}: nothing yet but to drive on; look again tomorrow: `boresight status --lake {quote(lake)}`."
    what = f"the {stored.sensor}" if stored.sensor else "all sensors"
    service = f"`boresight service {of} --day YYYY-MM-DD --kind re-mount --sensor {sensor}`"
    look = f"If somebody moved {what}, run {service} with that day; else look at the mounting at the next service."
    return f"{vehicle}: {load}. {look}"
