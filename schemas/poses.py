"""Table `poses`: where every sensor of a vehicle is, as the day's edges together say: a row per sensor. Append-only.

`calibrations` is the evidence, an edge at a time; this is the answer that a car loads.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import Posed, TableSchema, array, column, row

__all__ = ["POSES", "PoseRow"]


@row(eq=False)
class PoseRow(Posed):
    """One row of `poses`: T_reference_sensor; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS")
    sensor: str = column("name of the sensor, or base for the vehicle frame: b of T_a_b")
    kind: str = column("camera, lidar, radar or base")
    reference: str = column("name of the sensor that poses refer to: a of T_a_b")
    observability: list[float] | None = column(
        "per DoF: 1 - posterior/prior variance along it; 0 = the day adds nothing to the prior", default=None
    )
    status: str = column(
        "accepted (use it), held (computed, the prior stays current), refused (nothing computed)"
    )
    reason: str = column("why, in words; empty where accepted without remark")
    faults: list[str] = column(
        "faults that the reason names, keys of FAULTS in schemas/faults.py", default_factory=list
    )
    targets_m: np.ndarray | None = array(
        "<f8",
        (3, 3),
        "the targets, in the reference's frame: 15, 25 and 40 m away, where the sensor looks; null where refused and "
        "in rows of version 1",
        default=None,
    )
    dt_s: float | None = column(
        "clock: stamp_reference = stamp_sensor + dt; null where not estimated", default=None
    )
    dt_sigma_s: float | None = column("its sigma", default=None)
    edges: list[str] = column("edges that the pose rests on, as front-top", default_factory=list)
    view_azimuth_rad: float | None = column(
        "width in azimuth of the sensor's view, as its data show; null where they show none", default=None
    )
    notes: list[str] = column("what else a reader should know", default_factory=list)
    code_version: str = column("boresight version")
    inputs: list[str] = column("work keys or paths of what was read", default_factory=list)


POSES = TableSchema(
    PoseRow,
    "poses",
    2,
    "One row per sensor and method, the reference too. boresight show poses --json prints these names plus T, 4x4.",
    made_by="calibrate",
    reads_versions=(1,),
    about=("vehicle", "day", "method", "sensor"),
)
