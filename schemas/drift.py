"""Table `drift`: what the control charts say of each vehicle, pair and DoF. Append-only, a row per chart and audit.

The verdict on the vehicle as a whole stands in every one of its rows (`vehicle_*`), as the audit decided it; whoever
shows it reads it from there and decides nothing anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from shlex import quote

from schemas.columns import DEFAULT_TRIO, TableSchema, record_columns, scalar

__all__ = ["DRIFT", "DRIFT_STATUSES", "DriftFinding", "VehicleStatus", "next_step", "status_of"]

# What a person should look at first comes first; lists of vehicles are in this order.
DRIFT_STATUSES = ("RED", "YELLOW", "UNKNOWN", "GREEN")

DRIFT = TableSchema(
    "drift",
    2,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "last day of the audited window, YYYY-MM-DD"),
        scalar("method", "string", "method of the audited records"),
        scalar("pair", "string", "camera_lidar, camera_radar or lidar_radar"),
        scalar("dof", "string", "rx, ry, rz, tx, ty, tz in parent axes"),
        scalar(
            "status",
            "string",
            "of this chart: GREEN, YELLOW (a change below the limit that matters, or not yet sure), RED, UNKNOWN (too "
            "little data); of the vehicle: vehicle_status",
        ),
        scalar("reason", "string", "in words"),
        scalar("days_used", "int64", "day estimates on the chart"),
        scalar("statistic", "float64", "the chart's alarm statistic at its maximum", nullable=True),
        scalar("threshold", "float64", "its alarm threshold under the false-alarm budget", nullable=True),
        scalar("start_day", "string", "first day with the new value", nullable=True),
        scalar("start_day_earliest", "string", "lower end of the start day's interval", nullable=True),
        scalar("start_day_latest", "string", "upper end", nullable=True),
        scalar("kind", "string", "'step' or 'slow drift'", nullable=True),
        scalar("magnitude", "float64", "size of the change [rad or m]", nullable=True),
        scalar("magnitude_sigma", "float64", "its sigma", nullable=True),
        scalar("limit", "float64", "size that matters for this pair and DoF [rad or m]"),
        scalar(
            "moved_sensor",
            "string",
            "camera, lidar or radar: the sensor that two shifted pairs share",
            nullable=True,
        ),
        scalar(
            "moved_probability",
            "float64",
            "of moved_sensor against the other two, 0..1; null where nothing moved",
            nullable=True,
        ),
        scalar(
            "moved_motion",
            "list<float64>",
            "rotation vector [rad] and shift [m] of the moved sensor in its own axes",
            nullable=True,
        ),
        scalar("moved_motion_sigma", "list<float64>", "their sigmas", nullable=True),
        scalar("inputs", "list<string>", "work keys of the records on the chart"),
        scalar(
            "vehicle_status",
            "string",
            "of the vehicle as a whole, the same in all its rows of one audit: RED or YELLOW where a chart is, GREEN "
            "where a turn of any sensor would have shown, else UNKNOWN; null in rows of releases before 0.4",
            nullable=True,
        ),
        scalar(
            "vehicle_sensor",
            "string",
            "camera, lidar or radar: the sensor that moved; null where none did or it is not clear which",
            nullable=True,
        ),
        scalar("vehicle_since", "string", "first day after the vehicle's clearest change", nullable=True),
        scalar("vehicle_reason", "string", "why the vehicle has this status, in words", nullable=True),
        *record_columns(),
    ),
    made_by="audit",
    reads_versions=(1,),
    about=("vehicle", "day", "trio", "method", "pair", "dof"),
)


@dataclass(frozen=True)
class DriftFinding:
    """One row of `drift`; fields are the columns of the same name."""

    vehicle: str
    day: str
    method: str
    pair: str
    dof: str
    status: str
    reason: str
    days_used: int
    limit: float
    work_key: str = ""
    statistic: float | None = None
    threshold: float | None = None
    start_day: str | None = None
    start_day_earliest: str | None = None
    start_day_latest: str | None = None
    kind: str | None = None
    magnitude: float | None = None
    magnitude_sigma: float | None = None
    moved_sensor: str | None = None
    moved_probability: float | None = None
    moved_motion: list[float] | None = None
    moved_motion_sigma: list[float] | None = None
    inputs: list[str] = field(default_factory=list)
    vehicle_status: str | None = None
    vehicle_sensor: str | None = None
    vehicle_since: str | None = None
    vehicle_reason: str | None = None
    trio: str = DEFAULT_TRIO
    recorded_at: str = ""  # written when the row is
    asserted_at: str = ""


@dataclass(frozen=True)
class VehicleStatus:
    """The audit's verdict on one vehicle: columns `vehicle_*` of its rows."""

    status: str
    reason: str
    sensor: str | None = None
    since: str | None = None


def status_of(findings: Sequence[DriftFinding]) -> VehicleStatus:
    """The stored verdict on a vehicle; UNKNOWN, with the reason, where no audit has stored one.

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


def next_step(vehicle: str, stored: VehicleStatus, lake: str = "LAKE") -> str:
    """What a person should do about a vehicle that is RED, with the command; empty where nothing is to be done."""
    if stored.status != "RED":
        return ""
    sensor = stored.sensor or "all"
    what = f"how the {stored.sensor} is mounted" if stored.sensor else "how all sensors are mounted"
    command = (
        f"boresight service --lake {quote(lake)} --vehicle {quote(vehicle)} --day YYYY-MM-DD --kind repair"
    )
    return f"{vehicle}: inspect {what}; when it is mended, run `{command} --sensor {sensor}` with that day."
