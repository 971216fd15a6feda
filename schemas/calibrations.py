"""Table `calibrations`: the record of what one method found on one vehicle-day, one row per pair. Append-only."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from schemas.columns import DEFAULT_TRIO, TableSchema, array, record_columns, scalar, transform_columns

__all__ = [
    "ASKS_FOR_FRAMES",
    "CALIBRATIONS",
    "DOF_NAMES",
    "FRAMES_OF_PAIR",
    "METHODS",
    "PAIRS",
    "SENSORS",
    "STATUSES",
    "CalibrationRecord",
    "pairs_of",
]

SENSORS = ("camera", "lidar", "radar")
PAIRS = ("camera_lidar", "camera_radar", "lidar_radar")
FRAMES_OF_PAIR = {
    "camera_lidar": ("camera", "lidar"),
    "camera_radar": ("camera", "radar"),
    "lidar_radar": ("lidar", "radar"),
}
METHODS = ("joint", "tracking", "pairwise-optimisation", "joint-optimisation", "pairwise-ssl", "joint-ssl")
STATUSES = ("accepted", "held", "refused")
# What reasons say that more frames may clear: too few to fit or to judge by, or a direction that is not known well.
ASKS_FOR_FRAMES = ("too few frames", "too few held-out frames", "(1 sigma), not within ")
# Order of the covariance and of every per-DoF list: left perturbation T <- exp(xi) T, rotation vector then translation,
# both along the axes of the parent frame.
DOF_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")

CALIBRATIONS = TableSchema(
    "calibrations",
    4,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "YYYY-MM-DD"),
        scalar("method", "string", "one of METHODS"),
        scalar("pair", "string", "camera_lidar, camera_radar or lidar_radar"),
        scalar("parent_frame", "string", "a of T_a_b"),
        scalar("child_frame", "string", "b of T_a_b"),
        *transform_columns("", "the estimate of T_parent_child; null where refused", nullable=True),
        array(
            "covariance",
            "<f8",
            (6, 6),
            "of (rx ry rz tx ty tz), left perturbation in parent axes [rad, m]; null where refused",
            nullable=True,
        ),
        array(
            "common_covariance",
            "<f8",
            (6, 6),
            "the part of covariance that all days of a vehicle err by alike: bias floors, and the prior where the day "
            "leaves it its weight; covariance less it varies from day to day and averages down. Null where refused and "
            "in rows of version 1",
            nullable=True,
        ),
        scalar(
            "observability",
            "list<float64>",
            "per DoF: 1 - posterior/prior variance along it; 0 = the day adds nothing to the prior",
            nullable=True,
        ),
        scalar(
            "observable",
            "list<bool>",
            "per DoF: the day determined it; else it keeps prior and prior sigma",
            nullable=True,
        ),
        *transform_columns("prior_", "the prior; null where none was given", nullable=True),
        array("prior_covariance", "<f8", (6, 6), "of the prior, same order", nullable=True),
        scalar(
            "status",
            "string",
            "accepted (use it), held (computed, the prior stays current), refused (nothing computed)",
        ),
        scalar("reason", "string", "why, in words; empty where accepted without remark"),
        scalar("faults", "list<string>", "faults that the reason names, keys of FAULTS in schemas/faults.py"),
        scalar(
            "score",
            "float64",
            "smallest margin over the checks of the verdict: 1 = far inside, 0 = at a limit, below 0 = beyond",
            nullable=True,
        ),
        scalar(
            "determined",
            "list<string>",
            "of azimuth and elevation at targets 15 to 40 m away that both sensors see: those whose error is below "
            "limit_rad with probability verify.confidence",
        ),
        scalar(
            "limit_rad",
            "float64",
            "the largest error that the calibration's use allows; elevation's own is diagnostics' elevation_limit_rad",
            nullable=True,
        ),
        scalar(
            "azimuth_sigma_rad", "float64", "sigma of a target's azimuth, from the covariance", nullable=True
        ),
        scalar("elevation_sigma_rad", "float64", "sigma of its elevation", nullable=True),
        array(
            "targets_m",
            "<f8",
            (3, 3),
            "the targets, in child_frame: 15, 25 and 40 m away, where both sensors see; null where refused and in rows "
            "of version 3, whose targets lie before the child at -10, 8 and 0 deg",
            nullable=True,
        ),
        scalar(
            "mounting_determined",
            "list<string>",
            "of `determined`, the directions in which the mounting is within the limit as well; the others hold with "
            "this CameraInfo (and for the radar's detections) only",
        ),
        scalar(
            "mounting_azimuth_sigma_rad",
            "float64",
            "sigma of a target's azimuth by the mounting: with what is not known of CameraInfo's principal point; null "
            "where nothing says how well that is known",
            nullable=True,
        ),
        scalar(
            "mounting_elevation_sigma_rad",
            "float64",
            "and of its elevation: with a radar's own constant elevation error, too",
            nullable=True,
        ),
        array(
            "mounting_covariance",
            "<f8",
            (6, 6),
            "covariance of the pose as that of what is mounted, same order; null as its sigmas",
            nullable=True,
        ),
        scalar("trigger_before", "map<string,float64>", "the paper's trigger metrics at the prior"),
        scalar("trigger_after", "map<string,float64>", "the same at the result"),
        scalar("triggered", "bool", "a trigger metric exceeded its threshold at the prior"),
        scalar(
            "alignment_before",
            "float64",
            "alignment cost on held-out frames at the prior (lower is better)",
            nullable=True,
        ),
        scalar("alignment_after", "float64", "the same at the result", nullable=True),
        scalar("frames_total", "int64", "frames of the day"),
        scalar("frames_used", "int64", "frames that this pair was estimated from"),
        scalar("frames_rejected", "map<string,int64>", "frames not used, by reason"),
        scalar(
            "loop_rotation_rad",
            "float64",
            "angle of the loop of the three INDEPENDENT pair estimates, over the rotations that they determine",
            nullable=True,
        ),
        scalar(
            "loop_translation_m",
            "float64",
            "its translation; null where the independent estimates did not determine one",
            nullable=True,
        ),
        scalar(
            "loop_rotation_sigma_rad",
            "float64",
            "sigma of the angle as the pairs' covariances predict it",
            nullable=True,
        ),
        scalar("loop_translation_sigma_m", "float64", "and for the translation", nullable=True),
        array(
            "half_days",
            "<f8",
            (2, 2, 6),
            "of a day in which a sensor moved: how its first and its last part change the estimate (rx ry rz [rad], "
            "tx ty tz [m] of the child's origin, parent axes), and the sigmas of that; null on any other day",
            nullable=True,
        ),
        scalar("environment", "string", "highway, urban, mixed or unknown"),
        scalar(
            "time_offset_s",
            "float64",
            "dt: stamp_parent = stamp_child + dt; null where not estimated",
            nullable=True,
        ),
        scalar("time_offset_sigma_s", "float64", "its sigma", nullable=True),
        scalar("notes", "list<string>", "what else a reader should know"),
        scalar(
            "assumptions", "list<string>", "what was taken as known, and what an error of it would change"
        ),
        scalar("drive_missing", "list<string>", "what the day did not show: what to drive next time"),
        scalar(
            "diagnostics",
            "map<string,float64>",
            "numbers behind the verdict (origins of the search, halves, biases), names with units; `disproved` is 1 "
            "where a check shows that the pose is wrong",
        ),
        scalar("code_version", "string", "boresight version"),
        scalar("seed", "int64", "random seed"),
        scalar("inputs", "list<string>", "work keys or paths of what was read"),
        *record_columns(),
    ),
    "One row per pair and method. boresight show calibrations --json prints these names plus T, 4x4 row-major.",
    made_by="calibrate",
    reads_versions=(1, 2, 3),
    about=("vehicle", "day", "trio", "method", "pair"),
)


def pairs_of(sensors: Collection[str]) -> tuple[str, ...]:
    """The pairs of which both sensors are among the given ones, in order of PAIRS."""
    return tuple(pair for pair in PAIRS if set(FRAMES_OF_PAIR[pair]) <= set(sensors))


@dataclass(frozen=True, eq=False)
class CalibrationRecord:
    """One row of `calibrations`; fields are the columns of the same name."""

    vehicle: str
    day: str
    method: str
    pair: str
    parent_frame: str
    child_frame: str
    status: str
    reason: str
    work_key: str
    code_version: str
    seed: int
    frames_total: int = 0
    frames_used: int = 0
    environment: str = "unknown"
    triggered: bool = False
    qw: float | None = None
    qx: float | None = None
    qy: float | None = None
    qz: float | None = None
    tx_m: float | None = None
    ty_m: float | None = None
    tz_m: float | None = None
    covariance: np.ndarray | None = None
    common_covariance: np.ndarray | None = None
    observability: list[float] | None = None
    observable: list[bool] | None = None
    prior_qw: float | None = None
    prior_qx: float | None = None
    prior_qy: float | None = None
    prior_qz: float | None = None
    prior_tx_m: float | None = None
    prior_ty_m: float | None = None
    prior_tz_m: float | None = None
    prior_covariance: np.ndarray | None = None
    alignment_before: float | None = None
    alignment_after: float | None = None
    loop_rotation_rad: float | None = None
    loop_translation_m: float | None = None
    loop_rotation_sigma_rad: float | None = None
    loop_translation_sigma_m: float | None = None
    score: float | None = None
    limit_rad: float | None = None
    azimuth_sigma_rad: float | None = None
    elevation_sigma_rad: float | None = None
    targets_m: np.ndarray | None = None
    mounting_azimuth_sigma_rad: float | None = None
    mounting_elevation_sigma_rad: float | None = None
    mounting_covariance: np.ndarray | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    trigger_before: dict[str, float] = field(default_factory=dict)
    trigger_after: dict[str, float] = field(default_factory=dict)
    frames_rejected: dict[str, int] = field(default_factory=dict)
    determined: list[str] = field(default_factory=list)
    mounting_determined: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    drive_missing: list[str] = field(default_factory=list)
    diagnostics: dict[str, float] = field(default_factory=dict)
    half_days: np.ndarray | None = None
    inputs: list[str] = field(default_factory=list)
    trio: str = DEFAULT_TRIO
    recorded_at: str = ""  # written when the row is
    asserted_at: str = ""
