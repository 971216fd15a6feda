"""Table `states`: calibration to load tonight, from a vehicle's days since each sensor last moved.

One row per sensor, the reference included, and one per edge, composed of its sensors' poses.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import Posed, TableSchema, array, column, row
from schemas.words import STATE_WORDS, listed

__all__ = ["STATES", "StateRow"]

_PRIOR = "prior T_parent_child of the last day; null if unknown"
_REFERENCE = "mean pose T_parent_child of the reference days; null until there are enough of them"


@row(eq=False)
class StateRow(Posed):
    """One row of `states`: T_parent_child; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("last day of the audited window, YYYY-MM-DD")
    method: str = column("method of the records")
    pair: str = column(
        "kind of the edge: kinds of its two sensors, e.g. camera_lidar; 'pose' in rows of sensors"
    )
    parent_frame: str = column("frame a of T_a_b: name of a sensor, or base; for poses the reference")
    child_frame: str = column("frame b of T_a_b: name of a sensor, or base")
    status: str = column(listed(STATE_WORDS))
    reason: str = column("reason for `since`, days left out, and directions that are not certified")
    sensor: str | None = column(
        "sensor of a pose row, same as child_frame; null in rows of edges", default=None
    )
    kind: str | None = column("kind of that sensor: camera, lidar, radar or base", default=None)
    since: str | None = column("first day that may be used; null = no limit", default=None)
    days: list[str] = column("days from which the pose is computed", default_factory=list)
    inputs: list[str] = column("work keys of the records of these days", default_factory=list)
    prior_qw: float | None = column(_PRIOR, default=None)
    prior_qx: float | None = column(_PRIOR, default=None)
    prior_qy: float | None = column(_PRIOR, default=None)
    prior_qz: float | None = column(_PRIOR, default=None)
    prior_tx_m: float | None = column(_PRIOR, default=None)
    prior_ty_m: float | None = column(_PRIOR, default=None)
    prior_tz_m: float | None = column(_PRIOR, default=None)
    prior_covariance: np.ndarray | None = array(
        "<f8", (6, 6), "covariance of the prior, left perturbation [rad, m]", default=None
    )
    reference_days: list[str] | None = column(
        "first accepted days since reference_since, at most audit.reference_days: the charts' fixed "
        "reference is their mean; null in rows of sensors",
        default=None,
    )
    reference_since: str | None = column(
        "day of the last service event before reference_days; null = none", default=None
    )
    reference_count: int = column("audit.reference_days: number of days needed for the reference", default=0)
    reference_used: int = column(
        "number of reference_days in the mean: only days before the first step count", default=0
    )
    reference_qw: float | None = column(_REFERENCE, default=None)
    reference_qx: float | None = column(_REFERENCE, default=None)
    reference_qy: float | None = column(_REFERENCE, default=None)
    reference_qz: float | None = column(_REFERENCE, default=None)
    reference_tx_m: float | None = column(_REFERENCE, default=None)
    reference_ty_m: float | None = column(_REFERENCE, default=None)
    reference_tz_m: float | None = column(_REFERENCE, default=None)
    reference_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "covariance of the reference (rotation vector, shift of the child's origin) [rad, m], for independent days",
        default=None,
    )
    reference_observable: list[bool] | None = column(
        "per DoF: determined by at least one reference day", default=None
    )


STATES = TableSchema(
    StateRow, "states", 7, "boresight state prints the latest rows.", made_by="state",
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame"),
)  # fmt: skip
