"""Table `calibrations`: results of one method on one vehicle-day, one row per edge. Append-only."""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations

import numpy as np

from schemas.columns import FAULTS_DOC, OBSERVABILITY_DOC, STATUS_DOC, Posed, TableSchema, array, column, row

__all__ = [
    "ASKS_FOR_FRAMES", "CALIBRATIONS", "DOF_NAMES", "FRAMES_OF_PAIR", "METHODS", "PAIRS", "PROBE_Z",
    "SENSORS", "STATUSES", "CalibrationRecord", "pairs_of",
]  # fmt: skip

SENSORS = ("camera", "lidar", "radar")
FRAMES_OF_PAIR = {f"{parent}_{child}": (parent, child) for parent, child in combinations(SENSORS, 2)}
PAIRS = tuple(FRAMES_OF_PAIR)
METHODS = ("joint", "tracking", "pairwise-optimisation", "joint-optimisation", "pairwise-ssl", "joint-ssl")
STATUSES = ("accepted", "held", "refused")
# Beginnings and parts of reasons that more frames may clear: too few frames, or a sigma above the limit.
ASKS_FOR_FRAMES = ("too few frames", "too few held-out frames", "is too large for ")
# Start of the names in diagnostics of what held-out frames say of a turn of the result, e.g. probe_z_roll_-0.5 [deg].
PROBE_Z = "probe_z_"
# Order of the covariance and of every per-DoF list: left perturbation T <- exp(xi) T, rotation vector then
# translation, both along the axes of the parent frame.
DOF_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")

_PRIOR = "prior transform T_parent_child; null if there is none"
_OWN = "from this edge's own data and prior alone; null if equal to T, as in a rig without adjustment"


def pairs_of(sensors: Collection[str]) -> tuple[str, ...]:
    """Pairs whose sensors are both among the given kinds, in order of PAIRS."""
    return tuple(pair for pair in PAIRS if set(FRAMES_OF_PAIR[pair]) <= set(sensors))


@row(eq=False)
class CalibrationRecord(Posed):
    """One row of `calibrations`: T_parent_child; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS")
    pair: str = column("kind of the edge: kinds of its two sensors, e.g. camera_lidar")
    parent_frame: str = column("frame a of T_a_b: name of a sensor, or base")
    child_frame: str = column("frame b of T_a_b: name of a sensor, or base")
    observability: list[float] | None = column(OBSERVABILITY_DOC, default=None)
    prior_qw: float | None = column(_PRIOR, default=None)
    prior_qx: float | None = column(_PRIOR, default=None)
    prior_qy: float | None = column(_PRIOR, default=None)
    prior_qz: float | None = column(_PRIOR, default=None)
    prior_tx_m: float | None = column(_PRIOR, default=None)
    prior_ty_m: float | None = column(_PRIOR, default=None)
    prior_tz_m: float | None = column(_PRIOR, default=None)
    prior_covariance: np.ndarray | None = array("<f8", (6, 6), "prior covariance, same order", default=None)
    own_qw: float | None = column(_OWN, default=None)
    own_qx: float | None = column(_OWN, default=None)
    own_qy: float | None = column(_OWN, default=None)
    own_qz: float | None = column(_OWN, default=None)
    own_tx_m: float | None = column(_OWN, default=None)
    own_ty_m: float | None = column(_OWN, default=None)
    own_tz_m: float | None = column(_OWN, default=None)
    own_covariance: np.ndarray | None = array("<f8", (6, 6), f"covariance {_OWN}", default=None)
    own_common_covariance: np.ndarray | None = array(
        "<f8", (6, 6), "part of own_covariance from errors common to all days", default=None
    )
    own_observable: list[bool] | None = column(f"per DoF: determined {_OWN}", default=None)
    status: str = column(STATUS_DOC)
    reason: str = column("reason for the status; empty if accepted without a remark")
    faults: list[str] = column(FAULTS_DOC, default_factory=list)
    score: float | None = column(
        "smallest margin over the checks of the verdict: 1 = far inside, 0 = at a limit, below 0 = beyond",
        default=None,
    )
    limit_rad: float | None = column(
        "largest allowed error of azimuth; the limit of elevation is elevation_limit_rad in diagnostics",
        default=None,
    )
    targets_m: np.ndarray | None = array(
        "<f8",
        (3, 3),
        "targets in child_frame, 15, 25 and 40 m away, visible to both sensors; null if refused",
        default=None,
    )
    mounting_determined: list[str] = column(
        "subset of `determined`: directions in which the mounting is within the limit too; the others are valid "
        "with this CameraInfo (and for the radar's detections) only",
        default_factory=list,
    )
    mounting_azimuth_sigma_rad: float | None = column(
        "sigma of a target's azimuth for the mounting: includes the uncertainty of CameraInfo's principal point;"
        " null if that uncertainty is unknown",
        default=None,
    )
    mounting_elevation_sigma_rad: float | None = column(
        "sigma of a target's elevation for the mounting: includes a radar's constant elevation error",
        default=None,
    )
    mounting_covariance: np.ndarray | None = array(
        "<f8", (6, 6), "covariance of the mounting pose, same order; null like its sigmas", default=None
    )
    trigger_before: dict[str, float] = column(
        "trigger metrics of the paper at the prior; empty unless the method is the paper's or triggers decide",
        default_factory=dict,
    )
    trigger_after: dict[str, float] = column(
        "trigger metrics of the paper at the result", default_factory=dict
    )
    triggered: bool = column("a trigger metric exceeded its threshold at the prior", default=False)
    alignment_before: float | None = column(
        "alignment cost on held-out frames at the prior (lower is better)", default=None
    )
    alignment_after: float | None = column("alignment cost on held-out frames at the result", default=None)
    frames_total: int = column("number of frames of the day", default=0)
    frames_used: int = column("number of frames used to estimate this pair", default=0)
    frames_rejected: dict[str, int] = column("number of frames not used, by reason", default_factory=dict)
    loop_rotation_rad: float | None = column(
        "angle of the loop of three INDEPENDENT pair estimates, over the rotations that they determine",
        default=None,
    )
    loop_translation_m: float | None = column(
        "translation of that loop; null if the independent estimates do not determine it", default=None
    )
    loop_rotation_sigma_rad: float | None = column(
        "predicted sigma of the loop angle, from the covariances of the pairs", default=None
    )
    loop_translation_sigma_m: float | None = column("predicted sigma of the loop translation", default=None)
    half_days: np.ndarray | None = array(
        "<f8",
        (2, 2, 6),
        "for a day in which a sensor moved: change of the estimate by the first and the last part of the day; its "
        "sigmas; rx ry rz [rad], tx ty tz [m] of the child's origin, parent axes; null on other days",
        default=None,
    )
    innovation_sigmas: float | None = column(
        "difference between this edge's estimate and the one from the rig's other edges, in sigmas; null if no "
        "other edges join its sensors",
        default=None,
    )
    used: bool | None = column(
        "whether the adjustment of the whole rig uses this edge; null without an adjustment", default=None
    )
    environment: str = column("highway, urban, mixed or unknown", default="unknown")
    time_offset_s: float | None = column(
        "dt: stamp_parent = stamp_child + dt; null if not estimated", default=None
    )
    time_offset_sigma_s: float | None = column("its sigma", default=None)
    notes: list[str] = column("remarks", default_factory=list)
    assumptions: list[str] = column("assumptions, and the effect of an error in each", default_factory=list)
    drive_missing: list[str] = column(
        "driving that would provide the missing information", default_factory=list
    )
    diagnostics: dict[str, float] = column(
        "numbers behind the verdict (origins of the search, halves, biases), names with units; `disproved` is"
        " 1 if a check shows that the pose is wrong",
        default_factory=dict,
    )
    code_version: str = column("boresight version")
    seed: int = column("random seed")
    inputs: list[str] = column("work keys or paths of the inputs", default_factory=list)


CALIBRATIONS = TableSchema(
    CalibrationRecord,
    "calibrations",
    7,
    "One row per edge and method. boresight show calibrations --json prints these names plus T, 4x4 row-major.",
    made_by="calibrate",
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame"),
)
