"""Table `states`: what each vehicle should load tonight, per pair: its accepted days since the last change as one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from schemas.columns import DEFAULT_TRIO, TableSchema, array, record_columns, scalar, transform_columns

__all__ = ["STATES", "StateRow"]

STATES = TableSchema(
    "states",
    3,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "last day of the audited window, YYYY-MM-DD"),
        scalar("method", "string", "method of the records"),
        scalar("pair", "string", "camera_lidar, camera_radar or lidar_radar"),
        scalar("parent_frame", "string", "a of T_a_b"),
        scalar("child_frame", "string", "b of T_a_b"),
        scalar("status", "string", "current (load it) or none (no accepted day since the last change)"),
        scalar("reason", "string", "in words: since when, and what it does not rest on"),
        *transform_columns("", "the estimate of T_parent_child; null where there is none", nullable=True),
        array(
            "covariance",
            "<f8",
            (6, 6),
            "of (rx ry rz tx ty tz), left perturbation in parent axes [rad, m]; null where there is none",
            nullable=True,
        ),
        array(
            "common_covariance",
            "<f8",
            (6, 6),
            "the part of it that more days do not lower",
            nullable=True,
        ),
        scalar("observable", "list<bool>", "per DoF: at least one of the days determined it", nullable=True),
        scalar(
            "determined",
            "list<string>",
            "of azimuth and elevation at targets 15 to 40 m away: those whose error is below verify's limit with "
            "probability verify.confidence",
        ),
        scalar("azimuth_sigma_rad", "float64", "sigma of a target's azimuth", nullable=True),
        scalar("elevation_sigma_rad", "float64", "sigma of its elevation", nullable=True),
        scalar(
            "unchecked",
            "map<string,float64>",
            "DoF that at least half of its days found far from the prior and that nothing checks: the most sigmas",
        ),
        scalar("since", "string", "first day that may count; null where all may", nullable=True),
        scalar("days", "list<string>", "days that it rests on"),
        scalar("inputs", "list<string>", "work keys of their records"),
        scalar(
            "reference_days",
            "list<string>",
            "the first accepted days since reference_since, audit.reference_days at most: what the charts' fixed "
            "reference is made of; null in rows of version 1",
            nullable=True,
        ),
        scalar(
            "reference_since", "string", "day of the service event before them; null = none", nullable=True
        ),
        scalar(
            "reference_count", "int64", "audit.reference_days; with fewer days the reference is not made yet"
        ),
        scalar(
            "reference_used", "int64", "how many of them it rests on: those before the first step among them"
        ),
        *transform_columns(
            "reference_", "their mean pose T_parent_child; null until it is made", nullable=True
        ),
        array(
            "reference_covariance",
            "<f8",
            (6, 6),
            "of that mean, of (rotation vector, shift of the child's origin) [rad, m], were its days independent",
            nullable=True,
        ),
        scalar(
            "reference_observable", "list<bool>", "per DoF: at least one of them determined it", nullable=True
        ),
        *record_columns(),
    ),
    "boresight state prints the latest rows.",
    made_by="state",
    reads_versions=(1, 2),
    about=("vehicle", "day", "trio", "method", "pair"),
)


@dataclass(frozen=True, eq=False)
class StateRow:
    """One row of `states`; fields are the columns of the same name."""

    vehicle: str
    day: str
    method: str
    pair: str
    parent_frame: str
    child_frame: str
    status: str
    reason: str
    work_key: str = ""
    qw: float | None = None
    qx: float | None = None
    qy: float | None = None
    qz: float | None = None
    tx_m: float | None = None
    ty_m: float | None = None
    tz_m: float | None = None
    covariance: np.ndarray | None = None
    common_covariance: np.ndarray | None = None
    observable: list[bool] | None = None
    determined: list[str] = field(default_factory=list)
    azimuth_sigma_rad: float | None = None
    elevation_sigma_rad: float | None = None
    since: str | None = None
    days: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    reference_days: list[str] | None = None
    reference_since: str | None = None
    reference_count: int = 0
    reference_used: int = 0
    reference_qw: float | None = None
    reference_qx: float | None = None
    reference_qy: float | None = None
    reference_qz: float | None = None
    reference_tx_m: float | None = None
    reference_ty_m: float | None = None
    reference_tz_m: float | None = None
    reference_covariance: np.ndarray | None = None
    reference_observable: list[bool] | None = None
    trio: str = DEFAULT_TRIO
    recorded_at: str = ""  # written when the row is
    asserted_at: str = ""
    unchecked: dict[str, float] = field(default_factory=dict)
