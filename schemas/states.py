"""Table `states`: what each vehicle should load tonight: its accepted days since the last change as one.

A row per edge; of vehicles whose rig is adjusted as a whole (table `poses`), a row per sensor too, which are what to
load: all edges of a day agree on them.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import Posed, TableSchema, array, column, row

__all__ = ["STATES", "StateRow"]

_REFERENCE = "their mean pose T_parent_child; null until it is made"


@row(eq=False)
class StateRow(Posed):
    """One row of `states`: T_parent_child; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("last day of the audited window, YYYY-MM-DD")
    method: str = column("method of the records")
    pair: str = column(
        "kind of the edge: kinds of its two sensors, as camera_lidar; pose in a row per sensor"
    )
    parent_frame: str = column("a of T_a_b: name of a sensor, or base; of a pose the reference")
    child_frame: str = column("b of T_a_b: name of a sensor, or base")
    status: str = column("current (load it) or none (no accepted day since the last change)")
    reason: str = column("in words: since when, and what it does not rest on")
    unchecked: dict[str, float] = column(
        "DoF that at least half of its days found far from the prior and that nothing checks: the most sigmas",
        default_factory=dict,
    )
    sensor: str | None = column(
        "whose pose to the reference it is, child_frame once more; null in a row per edge", default=None
    )
    kind: str | None = column("camera, lidar, radar or base: of that sensor", default=None)
    since: str | None = column("first day that may count; null where all may", default=None)
    days: list[str] = column("days that it rests on", default_factory=list)
    inputs: list[str] = column("work keys of their records", default_factory=list)
    reference_days: list[str] | None = column(
        "the first accepted days since reference_since, audit.reference_days at most: what the charts' fixed "
        "reference is made of; null in rows of version 1",
        default=None,
    )
    reference_since: str | None = column("day of the service event before them; null = none", default=None)
    reference_count: int = column(
        "audit.reference_days; with fewer days the reference is not made yet", default=0
    )
    reference_used: int = column(
        "how many of them it rests on: those before the first step among them", default=0
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
        "of that mean, of (rotation vector, shift of the child's origin) [rad, m], were its days independent",
        default=None,
    )
    reference_observable: list[bool] | None = column(
        "per DoF: at least one of them determined it", default=None
    )


STATES = TableSchema(
    StateRow,
    "states",
    5,
    "boresight state prints the latest rows.",
    made_by="state",
    reads_versions=(1, 2, 3, 4),
    about=("vehicle", "day", "method", "pair", "parent_frame", "child_frame"),
)
