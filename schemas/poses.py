"""Table `poses`: pose of every sensor of a vehicle, from all edges of a day: a row per sensor. Append-only.

`calibrations` has the estimate of each edge; cars load `poses`.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import FAULTS_DOC, OBSERVABILITY_DOC, STATUS_DOC, Posed, TableSchema, array, column, row

__all__ = ["POSES", "PoseRow"]

_PRIOR = "prior transform T_reference_sensor; null if unknown"


@row(eq=False)
class PoseRow(Posed):
    """One row of `poses`: T_reference_sensor; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS")
    sensor: str = column("name of the sensor, or base for the vehicle frame: frame b of T_a_b")
    kind: str = column("camera, lidar, radar or base")
    reference: str = column("name of the reference sensor of all poses: frame a of T_a_b")
    observability: list[float] | None = column(OBSERVABILITY_DOC, default=None)
    status: str = column(STATUS_DOC)
    reason: str = column("reason for the status; empty if accepted without a remark")
    faults: list[str] = column(FAULTS_DOC, default_factory=list)
    targets_m: np.ndarray | None = array(
        "<f8",
        (3, 3),
        "targets in the reference's frame, 15, 25 and 40 m away, visible to the sensor; null if refused",
        default=None,
    )
    dt_s: float | None = column(
        "clock offset dt: stamp_reference = stamp_sensor + dt; null if not estimated", default=None
    )
    dt_sigma_s: float | None = column("its sigma", default=None)
    edges: list[str] = column("edges that the pose is computed from, e.g. front-top", default_factory=list)
    view_azimuth_rad: float | None = column(
        "horizontal field of view of the sensor, from its data; null if unknown", default=None
    )
    prior_qw: float | None = column(_PRIOR, default=None)
    prior_qx: float | None = column(_PRIOR, default=None)
    prior_qy: float | None = column(_PRIOR, default=None)
    prior_qz: float | None = column(_PRIOR, default=None)
    prior_tx_m: float | None = column(_PRIOR, default=None)
    prior_ty_m: float | None = column(_PRIOR, default=None)
    prior_tz_m: float | None = column(_PRIOR, default=None)
    prior_covariance: np.ndarray | None = array("<f8", (6, 6), "prior covariance, same order", default=None)
    unsure_only: bool = column(
        "held for its sigma alone, which exceeds the limits: the day counts in the state", default=False
    )
    notes: list[str] = column("remarks", default_factory=list)
    code_version: str = column("boresight version")
    inputs: list[str] = column("work keys or paths of the inputs", default_factory=list)


POSES = TableSchema(
    PoseRow,
    "poses",
    4,
    "One row per sensor and method, the reference too. boresight show poses --json prints these names plus T, 4x4.",
    made_by="calibrate",
    about=("vehicle", "day", "method", "sensor"),
)
