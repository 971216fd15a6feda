"""Tables `moments` and `perceived`: when the rig is looked at, and which rows of its sensors' files belong together."""

from __future__ import annotations

from typing import Final

from schemas.columns import TableSchema, column, row

__all__ = [
    "FILES",
    "MOMENTS",
    "PERCEIVED",
    "PRIOR",
    "RADAR_ALIGNMENT",
    "SAME_SCENE_NS",
    "SENSORS_ABSENT",
    "SWEEPS_LOGGED",
    "SWEEPS_PLANNED",
    "SWEEPS_READ",
    "EgoColumns",
    "Moment",
    "Perceived",
]

# Among the manifest's kept, of a day that was read in bursts: sweeps that its logs hold by their indices, that the
# plan was about, and that were read.
SWEEPS_LOGGED, SWEEPS_PLANNED, SWEEPS_READ = "sweeps_in_logs", "sweeps_planned", "sweeps_read"
# Among the manifest's extra: why moments lack a sensor, in words by sensor.
SENSORS_ABSENT = "sensors_absent"
# What radars state of their own alignment: by radar, columns of table `radar_alignments`.
RADAR_ALIGNMENT = "radar_alignment"
# Likewise: the table that a sensor's file is in, by sensor; and the transforms that the logs carry, each with the log,
# parent, child, q (w x y z) and t_m of T_parent_child.
FILES: Final = "files"
PRIOR: Final = "prior"
# Moments nearer in time than this show the same scene: one without all sensors adds nothing to a whole one beside it.
SAME_SCENE_NS = 10**9

_EGO = "T_odom_vehicle at stamp_ns from odometry"


@row()
class EgoColumns:
    """How the car moves at a moment, as odometry has it."""

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
    """What joins the rows of a moment."""

    moment: int = column("0, 1, 2, ... in order of stamp within the vehicle-day", kind="int32")
    log: str = column("file name of the log that the moment came from")
    drive: int = column(
        "continuous stretch of driving; grows where the log changes or stamps gap by more than 10 s",
        kind="int32",
    )
    stamp_ns: int = column(
        "the moment's time: the stamp of the sweep of the lidar that others were matched to, of a scan where the day "
        "has no sweep"
    )
    rows: dict[str, int] = column("by sensor, the row of its file; without those that the moment lacks")


@row()
class Moment(EgoColumns, Joined):
    """One row of `moments`."""

    gap_ns: dict[str, int] = column("by sensor, its stamp less the moment's")


@row()
class Perceived(Joined):
    """One row of `perceived`: a moment of which at least two sensors show something."""

    ego_speed_mps: float | None = column(
        "from odometry where logged, else from the Doppler fit of the static world"
    )
    ego_yaw_rate_radps: float | None = column("from odometry, else null")


MOMENTS = TableSchema(
    Moment, "moments", 1, "When the rig was looked at: which rows of images, sweeps and scans belong together.",
    made_by="ingest", before="frames",
)  # fmt: skip
PERCEIVED = TableSchema(
    Perceived, "perceived", 1, "Moments that perception saw something of, and the rows of its sensors' features.",
    made_by="perceive", before="observations",
)  # fmt: skip
