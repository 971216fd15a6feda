"""Table `radar_alignments`: a radar's alignment as its software reports it, and the day's calibration.

Azimuth is positive to the left of the radar's x axis, elevation upwards.
"""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["RADAR_ALIGNMENTS", "RadarAlignment"]

_OWN = "rotation of the radar from its prior by this day's calibration, about the same axis; null if unknown"


@row(eq=True)
class RadarAlignment(Recorded):
    """One row of `radar_alignments`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS: calibration method of that day")
    sensor: str = column("name of the radar")
    topics: list[str] = column("topics with the radar's alignment messages")
    sign_is_published: bool = column(
        "whether the radar driver or fleet.toml defines the signs of the angles", default=False
    )
    messages: int = column("number of messages with an angle")
    without_angle: int = column("number of messages without an angle", default=0)
    first_stamp_ns: int = column("stamp of the first message")
    last_stamp_ns: int = column("stamp of the last message")
    azimuth_rad: float | None = column(
        "misalignment in azimuth, median of the messages (after a step, if there is one); null without messages",
        default=None,
    )
    azimuth_sigma_rad: float | None = column(
        "sigma of the azimuth as reported; null if not reported", default=None
    )
    azimuth_scatter_rad: float | None = column(
        "scatter of the messages about the azimuth (1 sigma)", default=None
    )
    azimuth_step_rad: float | None = column(
        "step of the azimuth within the day; null if there is none", default=None
    )
    elevation_rad: float | None = column("misalignment in elevation, like azimuth_rad", default=None)
    elevation_sigma_rad: float | None = column("sigma of the elevation as reported", default=None)
    elevation_scatter_rad: float | None = column(
        "scatter of the messages about the elevation (1 sigma)", default=None
    )
    elevation_step_rad: float | None = column("step of the elevation within the day", default=None)
    step_stamp_ns: int | None = column("stamp of the first message after the step", default=None)
    statuses: dict[str, int] = column("number of messages by status, as logged", default_factory=dict)
    own_edge: str | None = column(
        "edge whose calibration own_* compare with, e.g. top-corner_fl", default=None
    )
    own_azimuth_rad: float | None = column(_OWN, default=None)
    own_azimuth_sigma_rad: float | None = column("its sigma", default=None)
    own_elevation_rad: float | None = column(_OWN, default=None)
    own_elevation_sigma_rad: float | None = column("its sigma", default=None)
    inputs: list[str] = column("work keys of the inputs", default_factory=list)


RADAR_ALIGNMENTS = TableSchema(
    RadarAlignment,
    "radar_alignments",
    1,
    "One row per radar with alignment messages (alignment = TOPIC in fleet.toml).",
    made_by="calibrate",
    about=("vehicle", "day", "method", "sensor"),
)
