"""Tables `moments` and `perceived`: stamps of the rig's moments, and the sensors' rows for each."""

from __future__ import annotations

from typing import Final

from schemas.columns import TableSchema, column, row

__all__ = [
    "FILES", "MOMENTS", "PERCEIVED", "PRIOR", "SAME_SCENE_NS", "SENSORS_ABSENT", "STATED_FAULTS",
    "SWEEPS_LOGGED", "SWEEPS_PLANNED", "SWEEPS_READ", "TF", "EgoColumns", "Moment", "Perceived",
]  # fmt: skip

# Key in the manifest's `kept`, for a day that was read in bursts: number of sweeps in the logs by their
# indices, of sweeps covered by the plan, and of sweeps read.
SWEEPS_LOGGED, SWEEPS_PLANNED, SWEEPS_READ = "sweeps_in_logs", "sweeps_planned", "sweeps_read"
# Key in the manifest's `extra`: reasons for missing sensors of moments, by sensor.
SENSORS_ABSENT = "sensors_absent"
# Likewise: faults that the remarks state, keys of `schemas.faults.FAULTS`.
STATED_FAULTS = "faults"
# Keys in the manifest's `extra`: table of each sensor's file; logged transforms, each with log, parent,
# child, q (w x y z) and t_m of T_parent_child.
FILES: Final = "files"
PRIOR: Final = "prior"
# Key in the manifest's `extra`: the car's own frames above its sensors, as logged on /tf_static, in the same layout.
TF: Final = "tf_static"
# Moments closer in time than this show the same scene: an incomplete one adds nothing to a complete one
# beside it.
SAME_SCENE_NS = 10**9

_EGO = "T_odom_vehicle at stamp_ns from odometry"


@row()
class EgoColumns:
    """Ego motion at a moment, from odometry."""

    ego_speed_mps: float | None = column("forward speed from odometry at stamp_ns")
    ego_yaw_rate_radps: float | None = column("yaw rate from odometry, positive to the left")
    ego_qw: float | None = column(_EGO)
    ego_qx: float | None = column(_EGO)
    ego_qy: float | None = column(_EGO)
    ego_qz: float | None = column(_EGO)
    ego_tx_m: float | None = column(_EGO)
    ego_ty_m: float | None = column(_EGO)
    ego_tz_m: float | None = column(_EGO)


@row()
class Joined:
    """Columns that join the rows of a moment."""

    moment: int = column("0, 1, 2, ... in order of stamp within the vehicle-day", kind="int32")
    log: str = column("file name of the log with this moment")
    drive: int = column(
        "number of the continuous drive; increments with a new log or a gap of more than 10 s", kind="int32"
    )
    stamp_ns: int = column(
        "time of the moment: stamp of the reference lidar's sweep; of a radar scan if the day has no sweep"
    )
    rows: dict[str, int] = column("row in the file of each sensor; absent sensors are left out")


@row()
class Moment(EgoColumns, Joined):
    """One row of `moments`."""

    gap_ns: dict[str, int] = column("stamp of each sensor minus stamp_ns")


@row()
class Perceived(Joined):
    """One row of `perceived`: a moment with features of at least two sensors."""

    ego_speed_mps: float | None = column(
        "from odometry if logged, else from the Doppler fit of static detections"
    )
    ego_yaw_rate_radps: float | None = column("from odometry, else null")


MOMENTS = TableSchema(
    Moment, "moments", 1, "Stamps of the rig's moments, and the rows of images, sweeps and scans for each.",
    made_by="ingest",
)  # fmt: skip
PERCEIVED = TableSchema(
    Perceived, "perceived", 1, "Moments with features, and the rows of the sensors' features for each.",
    made_by="perceive",
)  # fmt: skip
