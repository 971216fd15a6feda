"""`boresight report`: HTML pages of one vehicle-day, or of the whole fleet."""

from __future__ import annotations

from pathlib import Path

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import REPORT
from pipeline.report.stage import Pages, write_day_picture
from pipeline.report.truth import read_truth
from pipeline.store.partitions import Lake, Partition

__all__ = ["report"]


def report(
    *,
    fleet: Path,
    lake: str,
    out: Path,
    vehicle: str | None = None,
    day: str | None = None,
    method: str | None = None,
    truth: Path | None = None,
    picture: Path | None = None,
    pictures: bool = True,
) -> int:
    """Write self-contained HTML: one day with --vehicle and --day, otherwise the fleet with all its days.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        out: HTML file to write; pages of days are written to a folder next to it.
        vehicle: vehicle id.
        day: YYYY-MM-DD.
        method: calibration method of the records; default: audit.method.
        truth: folder with the true poses of a simulated fleet (VEHICLE/DAY.json), shown next to the estimates.
        picture: picture to write of the frame with most features; needs --vehicle and --day. A .jpg or .png shows the
            prior on the left and the result on the right; a .webp or .gif moves from one to the other.
        pictures: --no-pictures draws pages without images of public roads.
    """
    if (vehicle is None) != (day is None):
        raise ConfigError("command line", "vehicle, day", "a day's page needs both --vehicle and --day")
    if picture is not None and day is None:
        raise ConfigError("command line", "picture", "a picture shows one day: give --vehicle and --day")
    config, tables = load_fleet(fleet), Lake.existing(lake)
    of = Partition(vehicle, day) if vehicle is not None and day is not None else Window()
    pages = Pages(out, read_truth(truth) if truth is not None else None, pictures)
    with progress_reporter("report") as progress:
        progress(0, 0, f"page of {vehicle} {day}" if day else "pages")
        outcome = REPORT.run(Task(config, tables, of, method, given=pages, progress=progress))
        outputs = [*outcome.outputs]
        if picture is not None and isinstance(of, Partition):
            progress(0, 0, "picture")
            outputs.append(str(write_day_picture(tables, of, config, picture, method)))
    print_summary("report", outcome.status, report=out, outputs=outputs)
    return 0
