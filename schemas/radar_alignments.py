"""Table `radar_alignments`: what a radar's own software says of its alignment on a day, beside the day's calibration.

Azimuth is positive to the left of the radar's x axis, elevation upwards.
"""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["RADAR_ALIGNMENTS", "RadarAlignment"]

_OWN = (
    "by which this day's calibration turned the radar from its prior, about the same axis; null where unknown"
)


@row(eq=True)
class RadarAlignment(Recorded):
    """One row of `radar_alignments`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    method: str = column("one of METHODS: of the calibration beside it")
    sensor: str = column("name of the radar")
    topics: list[str] = column("topics of its messages")
    sign_is_published: bool = column(
        "whether the maker, or fleet.toml, says which way the angles count", default=False
    )
    messages: int = column("messages that were read and state an angle")
    without_angle: int = column("messages that were read and state none", default=0)
    first_stamp_ns: int = column("stamp of the first of them")
    last_stamp_ns: int = column("stamp of the last")
    azimuth_rad: float | None = column(
        "misalignment in azimuth, median of the messages, of those after a step; null where no message states it",
        default=None,
    )
    azimuth_sigma_rad: float | None = column(
        "its sigma by the messages; null where they state none", default=None
    )
    azimuth_scatter_rad: float | None = column("sigma by which the messages scatter about it", default=None)
    azimuth_step_rad: float | None = column(
        "step of the azimuth within the day; null where there is none", default=None
    )
    elevation_rad: float | None = column("the same in elevation", default=None)
    elevation_sigma_rad: float | None = column("its sigma by the messages", default=None)
    elevation_scatter_rad: float | None = column("sigma by which the messages scatter about it", default=None)
    elevation_step_rad: float | None = column("step of the elevation within the day", default=None)
    step_stamp_ns: int | None = column("stamp of the first message after the step", default=None)
    statuses: dict[str, int] = column("how many messages of which status, as logged", default_factory=dict)
    own_edge: str | None = column("edge that own_* are of, as top-corner_fl", default=None)
    own_azimuth_rad: float | None = column(_OWN, default=None)
    own_azimuth_sigma_rad: float | None = column("its sigma", default=None)
    own_elevation_rad: float | None = column(_OWN, default=None)
    own_elevation_sigma_rad: float | None = column("its sigma", default=None)
    inputs: list[str] = column("work keys of what was read", default_factory=list)


RADAR_ALIGNMENTS = TableSchema(
    RadarAlignment,
    "radar_alignments",
    1,
    "One row per radar whose messages about its alignment fleet.toml names (alignment = TOPIC).",
    made_by="calibrate",
    about=("vehicle", "day", "method", "sensor"),
)
