"""Table `calibrations`: the record of what one method found on one vehicle-day, one row per edge. Append-only."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from schemas.columns import Posed, TableSchema, array, column, row

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

_PRIOR = "the prior; null where none was given"


def pairs_of(sensors: Collection[str]) -> tuple[str, ...]:
    """The pairs of which both sensors are among the given ones, in order of PAIRS."""
    return tuple(pair for pair in PAIRS if set(FRAMES_OF_PAIR[pair]) <= set(sensors))


@row(eq=False)
class CalibrationRecord(Posed):
    """One row of `calibrations`: T_parent_child; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS")
    pair: str = column("kind of the edge: kinds of its two sensors, as camera_lidar")
    parent_frame: str = column("a of T_a_b: name of a sensor, or base")
    child_frame: str = column("b of T_a_b: name of a sensor, or base")
    observability: list[float] | None = column(
        "per DoF: 1 - posterior/prior variance along it; 0 = the day adds nothing to the prior", default=None
    )
    prior_qw: float | None = column(_PRIOR, default=None)
    prior_qx: float | None = column(_PRIOR, default=None)
    prior_qy: float | None = column(_PRIOR, default=None)
    prior_qz: float | None = column(_PRIOR, default=None)
    prior_tx_m: float | None = column(_PRIOR, default=None)
    prior_ty_m: float | None = column(_PRIOR, default=None)
    prior_tz_m: float | None = column(_PRIOR, default=None)
    prior_covariance: np.ndarray | None = array("<f8", (6, 6), "of the prior, same order", default=None)
    status: str = column(
        "accepted (use it), held (computed, the prior stays current), refused (nothing computed)"
    )
    reason: str = column("why, in words; empty where accepted without remark")
    faults: list[str] = column(
        "faults that the reason names, keys of FAULTS in schemas/faults.py", default_factory=list
    )
    score: float | None = column(
        "smallest margin over the checks of the verdict: 1 = far inside, 0 = at a limit, below 0 = beyond",
        default=None,
    )
    limit_rad: float | None = column(
        "the largest error that the calibration's use allows; elevation's own is diagnostics' "
        "elevation_limit_rad",
        default=None,
    )
    targets_m: np.ndarray | None = array(
        "<f8",
        (3, 3),
        "the targets, in child_frame: 15, 25 and 40 m away, where both sensors see; null where refused and in"
        " rows of version 3, whose targets lie before the child at -10, 8 and 0 deg",
        default=None,
    )
    mounting_determined: list[str] = column(
        "of `determined`, the directions in which the mounting is within the limit as well; the others hold "
        "with this CameraInfo (and for the radar's detections) only",
        default_factory=list,
    )
    mounting_azimuth_sigma_rad: float | None = column(
        "sigma of a target's azimuth by the mounting: with what is not known of CameraInfo's principal point;"
        " null where nothing says how well that is known",
        default=None,
    )
    mounting_elevation_sigma_rad: float | None = column(
        "and of its elevation: with a radar's own constant elevation error, too", default=None
    )
    mounting_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "covariance of the pose as that of what is mounted, same order; null as its sigmas",
        default=None,
    )
    trigger_before: dict[str, float] = column(
        "the paper's trigger metrics at the prior", default_factory=dict
    )
    trigger_after: dict[str, float] = column("the same at the result", default_factory=dict)
    triggered: bool = column("a trigger metric exceeded its threshold at the prior", default=False)
    alignment_before: float | None = column(
        "alignment cost on held-out frames at the prior (lower is better)", default=None
    )
    alignment_after: float | None = column("the same at the result", default=None)
    frames_total: int = column("frames of the day", default=0)
    frames_used: int = column("frames that this pair was estimated from", default=0)
    frames_rejected: dict[str, int] = column("frames not used, by reason", default_factory=dict)
    loop_rotation_rad: float | None = column(
        "angle of the loop of the three INDEPENDENT pair estimates, over the rotations that they determine",
        default=None,
    )
    loop_translation_m: float | None = column(
        "its translation; null where the independent estimates did not determine one", default=None
    )
    loop_rotation_sigma_rad: float | None = column(
        "sigma of the angle as the pairs' covariances predict it", default=None
    )
    loop_translation_sigma_m: float | None = column("and for the translation", default=None)
    half_days: np.ndarray | None = array(
        "<f8",
        (2, 2, 6),
        "of a day in which a sensor moved: how its first and its last part change the estimate (rx ry rz "
        "[rad], tx ty tz [m] of the child's origin, parent axes), and the sigmas of that; null on any other "
        "day",
        default=None,
    )
    innovation_sigmas: float | None = column(
        "how far the edge's own estimate lies from what the rig's other edges say; null where no other way joins its "
        "sensors, and in rows before version 5",
        default=None,
    )
    used: bool | None = column(
        "whether the adjustment of the whole rig rests on this edge too; null in rows before version 5",
        default=None,
    )
    environment: str = column("highway, urban, mixed or unknown", default="unknown")
    time_offset_s: float | None = column(
        "dt: stamp_parent = stamp_child + dt; null where not estimated", default=None
    )
    time_offset_sigma_s: float | None = column("its sigma", default=None)
    notes: list[str] = column("what else a reader should know", default_factory=list)
    assumptions: list[str] = column(
        "what was taken as known, and what an error of it would change", default_factory=list
    )
    drive_missing: list[str] = column(
        "what the day did not show: what to drive next time", default_factory=list
    )
    diagnostics: dict[str, float] = column(
        "numbers behind the verdict (origins of the search, halves, biases), names with units; `disproved` is"
        " 1 where a check shows that the pose is wrong",
        default_factory=dict,
    )
    code_version: str = column("boresight version")
    seed: int = column("random seed")
    inputs: list[str] = column("work keys or paths of what was read", default_factory=list)


CALIBRATIONS = TableSchema(
    CalibrationRecord,
    "calibrations",
    5,
    "One row per edge and method. boresight show calibrations --json prints these names plus T, 4x4 row-major.",
    made_by="calibrate",
    reads_versions=(1, 2, 3, 4),
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame"),
)
