"""Table `set_checks`: answers of a data set's logs about the calibrations that it ships. Append-only.

It is in the folder of `boresight verify-set`, which is not the lake of a fleet.
"""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["SET_CHECKS", "SetCheck"]


@row(eq=True)
class SetCheck(Recorded):
    """One axis of one sensor in one log, as shipped or turned on purpose."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    log: str = column("path of the log, or of the first one of a vehicle-day")
    rig: str = column("rig of the vehicle in fleet.toml", default="")
    shipped: str = column("hash of the calibration that the log ships", default="")
    turn: str = column(
        "turn of the shipped calibration: sensor, axis, degrees; empty = as shipped", default=""
    )
    turn_sensor: str = column("sensor that was turned, or that has the fault", default="")
    turn_axis: str = column("azimuth, elevation or roll of the turn", default="")
    turn_deg: float = column("size of the turn with its sign", default=0.0)
    fault: str = column("fault put into the log's data (then turn is its name); empty = none", default="")
    fused: int = column(
        "number of logs whose answers are summed in this row, of one vehicle and calibration; 0 = one log",
        default=0,
    )
    fused_used: int = column("of these logs, those that give an estimate of the axis", default=0)
    sensor: str = column("sensor that is checked; empty for a log that gives no answer at all", default="")
    kind: str = column("kind of the pair whose limits apply", default="")
    axis: str = column("azimuth, elevation or roll", default="")
    answer: str = column(
        "about the sensor: right, wrong or undecided; about a log without one: a word of NO_ANSWER"
    )
    status: str = column("of the axis: pass, warn, fail or inconclusive", default="")
    reason: str = column("reason for status or answer", default="")
    off_rad: float | None = column("distance of the calibration from the log's own", default=None)
    sigma_rad: float | None = column("sigma of the log's own", default=None)
    signed_rad: float | None = column("off_rad with its sign", default=None)
    common_rad: float | None = column(
        "part of sigma_rad that all logs of a vehicle share: it does not average out", default=None
    )
    limit_rad: float | None = column("error that makes a calibration wrong", default=None)
    asked_rad: float | None = column("error that must be detected", default=None)
    power: float | None = column(
        "probability, by sigma and held-out frames, that an error of asked_rad would have failed",
        default=None,
    )
    shown_rad: float | None = column(
        "size from which on errors would have failed with probability 95 %; null = none of those tried",
        default=None,
    )
    beyond: float | None = column("sigmas beyond which the axis fails", default=None)
    held_out_z: dict[str, float] = column(
        "by turn of the log's answer [deg]: z of held-out frames, negative = they prefer the answer",
        default_factory=dict,
    )
    reads: list[str] = column("inputs of the log's answer", default_factory=list)
    passes_rad: dict[str, float] = column(
        "by source: error of that source alone that no check of the log shows", default_factory=dict
    )
    code_version: str = column("boresight version", default="")


SET_CHECKS = TableSchema(
    SetCheck,
    "set_checks",
    1,
    "One row per log, turn, sensor and axis.",
    made_by="verify-set",
    about=("vehicle", "day", "log", "turn", "sensor", "axis"),
)
