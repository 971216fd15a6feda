"""Table `drift`: what the control charts say of each vehicle, pair and DoF. Append-only, a row per chart and audit."""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas.columns import TableSchema, scalar

__all__ = ["DRIFT", "DRIFT_STATUSES", "DriftFinding"]

DRIFT_STATUSES = ("GREEN", "YELLOW", "RED", "UNKNOWN")

DRIFT = TableSchema(
    "drift",
    1,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "last day of the audited window, YYYY-MM-DD"),
        scalar("method", "string", "method of the audited records"),
        scalar("pair", "string", "camera_lidar, camera_radar or lidar_radar"),
        scalar("dof", "string", "rx, ry, rz, tx, ty, tz in parent axes"),
        scalar(
            "status",
            "string",
            "GREEN, YELLOW (a change below the limit that matters, or not yet sure), RED, UNKNOWN (too little data)",
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
        scalar("work_key", "string", "hash of code version, config, inputs"),
        scalar("inputs", "list<string>", "work keys of the records on the chart"),
    ),
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
