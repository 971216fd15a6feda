"""Tables `fleet_model` and `line_answers`: what the vehicles of a model line share, and each vehicle's answer with it.

A night adds its day to the sums of `line_answers`; both tables are written for all vehicles together.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import Posed, Recorded, TableSchema, array, column, row

__all__ = ["FLEET_MODEL", "LINE_ANSWERS", "LINE_STATUSES", "OF_ALL", "FleetModelRow", "LineAnswer"]

# Most urgent first. RED: part of the line moved together; UNKNOWN: its vehicles contradict each other, or are too few.
LINE_STATUSES = ("RED", "UNKNOWN", "GREEN")
OF_ALL = "*"  # in column `vehicle` of rows about all vehicles of a line

_CHANGE = "changes: rotation vector [rad], shift of the child's origin [m], in the parent's axes"
_PAIR = (
    "kind of the edge: kinds of its two sensors, e.g. camera_lidar; 'pose' in rows of an adjusted rig's poses"
)
_KINDS = "kinds of frames a and b, e.g. lidar_camera: those of pair, but for poses"
_RELEASE = "boresight version that learnt it, from records of its own release alone"
_DRAWING = (
    "drawing T_parent_child: the median of the vehicles' priors when the line began; changes count from it"
)


@row(eq=False)
class FleetModelRow(Recorded):
    """One row of `fleet_model`: an edge of a model line; fields are the columns of the same name."""

    vehicle: str = column("always *: the row is about all vehicles of the line")
    day: str = column("last day of the window, YYYY-MM-DD")
    method: str = column("method of the records")
    line: str = column("model line: `model` of the vehicles in fleet.toml, or else their rig")
    pair: str = column(_PAIR)
    kinds: str = column(_KINDS)
    parent_frame: str = column("frame a of T_a_b: name of a sensor, or base; for poses the reference")
    child_frame: str = column("frame b of T_a_b: name of a sensor, or base")
    code_version: str = column(_RELEASE)
    status: str = column(
        "GREEN (vehicles share what they have in common), UNKNOWN (too few vehicles, or they contradict each other), "
        "RED (part of the line moved together); only a GREEN line has a part in its vehicles' answers"
    )
    reason: str = column("reason for the status")
    vehicles: int = column("number of vehicles with days")
    outside: list[str] = column("vehicles that differ from the line", default_factory=list)
    since: str | None = column("first day of any vehicle that counts", default=None)
    other_releases: list[str] = column(
        "releases whose records do not count, as each errs in its own way, and their last days",
        default_factory=list,
    )
    drawing_qw: float | None = column(_DRAWING, default=None)
    drawing_qx: float | None = column(_DRAWING, default=None)
    drawing_qy: float | None = column(_DRAWING, default=None)
    drawing_qz: float | None = column(_DRAWING, default=None)
    drawing_tx_m: float | None = column(_DRAWING, default=None)
    drawing_ty_m: float | None = column(_DRAWING, default=None)
    drawing_tz_m: float | None = column(_DRAWING, default=None)
    prior_sigma: list[float] | None = column(
        f"sigmas of the vehicles' priors, by axis of {_CHANGE}: their median", default=None
    )
    mean: np.ndarray | None = array(
        "<f8",
        ("N",),
        f"common error of all mounts (6 numbers), then the error that all sensors share (6); {_CHANGE}; null unless "
        "there are enough vehicles",
        default=None,
    )
    mean_covariance: np.ndarray | None = array(
        "<f8",
        ("N",),
        "covariance of mean, row-major; as wide as the priors where data do not tell",
        default=None,
    )
    scatter: list[float] | None = column(
        f"scatter of the vehicles' mounts about the mean (1 sigma), by axis of {_CHANGE}; nan where too few "
        "vehicles determine the axis",
        default=None,
    )
    scatter_most: list[float] | None = column(
        "scatter that answers rest on: one sigma above, so that few vehicles share less", default=None
    )
    day_scale: list[float] | None = column(
        "ratio of the days' scatter to their sigmas, by axis: median of the vehicles' charts", default=None
    )
    day_autocorrelation: list[float] | None = column(
        "autocorrelation of neighbouring days' errors, by axis: median of the vehicles' charts", default=None
    )
    shared_errors: dict[str, float] = column(
        "errors that all sensors of the line share [rad or m]; those that are not in told_apart stay near zero, their "
        "prior",
        default_factory=dict,
    )
    shared_error_sigmas: dict[str, float] = column("sigmas of shared_errors", default_factory=dict)
    totals: dict[str, float] = column(
        "shared error and common mount error together, which records determine, by the same names [rad or m]",
        default_factory=dict,
    )
    total_sigmas: dict[str, float] = column("sigmas of totals", default_factory=dict)
    told_apart: list[str] = column(
        "shared errors that data tell from a common error of all mounts; the others are part of nobody's certainty",
        default_factory=list,
    )
    moved: str = column(
        "how the line moved in its last days: none, whole (all vehicles alike: one event, such as a software release) "
        "or part",
        default="none",
    )
    moved_axis: str | None = column("axis of the clearest motion", default=None)
    moved_size: float | None = column("mean motion of all vehicles along it [rad or m]", default=None)
    moved_vehicles: int = column("vehicles that moved by more than 3 of their sigmas", default=0)
    clock_mean_s: float | None = column(
        "time offset of the line, stamp_parent = stamp_child + dt, from the last 14 days; null without enough "
        "vehicles that estimate it",
        default=None,
    )
    clock_sigma_s: float | None = column("its sigma", default=None)
    clock_scatter_s: float | None = column(
        "scatter of the vehicles' offsets about it (1 sigma)", default=None
    )
    clock_outside: list[str] = column("vehicles whose offset differs from the line's", default_factory=list)
    clock_step_s: float | None = column(
        "step of all offsets in the last 3 days, as of a software release; null = none is seen", default=None
    )
    clock_step_sigma_s: float | None = column("its sigma", default=None)
    most_without_one: float | None = column(
        "largest change of any vehicle's answer, in its sigmas, if any one other vehicle is left out",
        default=None,
    )


@row(eq=False)
class LineAnswer(Posed):
    """One row of `line_answers`: T_parent_child with the line; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("last day of the window, YYYY-MM-DD")
    method: str = column("method of the records")
    line: str = column("model line")
    pair: str = column(_PAIR)
    kinds: str = column(_KINDS)
    parent_frame: str = column("frame a of T_a_b: name of a sensor, or base; for poses the reference")
    child_frame: str = column("frame b of T_a_b: name of a sensor, or base")
    code_version: str = column(_RELEASE)
    status: str = column(
        "shared (the line has a part in the answer), outside (the vehicle differs from its line, its last days lie "
        "elsewhere, or the line makes it no surer: its answer is that of the vehicle alone) or alone (the line is not "
        "GREEN)"
    )
    reason: str = column("reason for the status")
    distance_sigmas: float | None = column(
        "largest distance from the line along an axis, in sigmas; null without a line", default=None
    )
    distance_axis: str | None = column("axis of that distance", default=None)
    differs: bool = column("the distance has a probability below 1 in 1,000", default=False)
    moved_by: list[float] | None = column(
        f"from the vehicle's answer alone to the one with the line; {_CHANGE}", default=None
    )
    alone_covariance: np.ndarray | None = array(
        "<f8", (6, 6), "covariance of the vehicle's answer alone, left perturbation [rad, m]", default=None
    )
    record_day: str | None = column("last day with a usable record", default=None)
    record_change: list[float] | None = column(
        f"that day's own estimate with the line, relative to the answer with the line; {_CHANGE}; null without a line",
        default=None,
    )
    record_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "covariance of that day's estimate with the line, left perturbation [rad, m]",
        default=None,
    )
    record_alone_covariance: np.ndarray | None = array(
        "<f8", (6, 6), "covariance of that day's estimate alone, left perturbation [rad, m]", default=None
    )
    sums: np.ndarray | None = array(
        "<f8", (5, 27),
        "sums over days for the next night: information (lower triangle) and pull of all days, of the last days, of "
        "the last day; common covariance and change from the drawing to the prior; covariance of the prior",
        default=None,
    )  # fmt: skip
    days: float = column("number of days, older ones counted less", default=0.0)
    recent_days: float = column("number of the last days", default=0.0)
    first_day: str | None = column("first day that counts", default=None)
    last_day: str | None = column("last day that counts", default=None)
    away: int = column("days in a row that are left out, far from the others", default=0)
    restart: str = column(
        "first day that may count, after a service event or a change; empty = any", default=""
    )
    recent_keys: list[str] = column(
        "day, asserted_at and work key of counted records that the next night may read again",
        default_factory=list,
    )
    read_until: str = column(
        "asserted_at of the last record of any vehicle that was read: a later night reads later ones",
        default="",
    )


FLEET_MODEL = TableSchema(
    FleetModelRow,
    "fleet_model",
    1,
    "One row per model line and edge: what its vehicles share. boresight show fleet_model --current prints it.",
    made_by="lines",
    about=("vehicle", "day", "method", "line", "pair", "parent_frame", "child_frame"),
)
LINE_ANSWERS = TableSchema(
    LineAnswer,
    "line_answers",
    1,
    "One row per vehicle and edge: its answer with its model line, and the sums that the next night adds to.",
    made_by="lines",
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame"),
)
