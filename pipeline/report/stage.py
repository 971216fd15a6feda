"""Stage report: tables to HTML pages, one per vehicle-day and one for the fleet."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath

import numpy as np

from pipeline.core.config import FleetConfig
from pipeline.core.results import Progress, silent
from pipeline.core.stage_work import Run, Task, Work
from pipeline.report.day_page import write_day_page, write_day_picture
from pipeline.report.fleet_page import render_fleet_page
from pipeline.report.reading import records_of_day
from pipeline.report.upkeep import Album, FanOut, draw_days, one_by_one, stamp_of
from pipeline.report.verdicts import read_verdicts
from pipeline.report.window import read_window
from pipeline.store.files import Files, LocalFiles
from pipeline.store.partitions import Lake, Partition, last_possible_day

__all__ = ["Pages", "work", "write_day_page", "write_day_picture", "write_fleet_report"]


@dataclass(frozen=True)
class Pages:
    """Inputs of a task of this stage.

    Args:
        truth: truth of a simulated fleet.
        pictures: False = pages without images of public roads.
        also: vehicle-days processed by a night, which get a page at any age.
        fan_out: executor that draws pages of days.
    """

    out: PurePath
    truth: Mapping[tuple[str, str], Mapping[str, np.ndarray]] | None = None
    pictures: bool = True
    files: Files = field(default_factory=LocalFiles)
    also: Sequence[Partition] = ()
    fan_out: FanOut = one_by_one


def work(task: Task) -> Work:
    """The page of a vehicle-day, or the pages of the fleet and all its days, depending on the task's `Pages`."""
    pages: Pages = task.given
    settings = ({"method": task.method or task.fleet.audit.method, "of": str(task.of)},)

    def rows(run: Run) -> Generator[PurePath, None, None]:
        if isinstance(task.of, Partition):
            yield write_day_page(
                task.lake, task.of, task.fleet, pages.out, task.method, pictures=pages.pictures
            )
        else:
            yield from write_fleet_report(task.lake, task.fleet, pages, task.method, progress=run.progress)

    return Work(settings, rows, inputs=())


def write_fleet_report(
    lake: Lake, fleet: FleetConfig, pages: Pages, method: str | None = None, *, progress: Progress = silent
) -> list[PurePath]:
    """Write the pages of vehicle-days, in a folder next to the fleet page, then the fleet page (returned first).

    An existing page of a day is not drawn again for the same records. Days are those of the last
    `audit.window_days`, more for vehicles that drive rarely, and `pages.also`.
    """
    album = Album(lake, fleet, method or fleet.audit.method, pages.out, pages.files, pages.pictures)
    window = read_window(lake, album.method, fleet.audit.window_days, last_possible_day())
    verdicts = read_verdicts(lake, album.method)
    keys = window.vehicle_days()
    keys |= _keys_of(album, [p for p in pages.also if (p.vehicle, p.day) not in keys])
    stamps = {of: stamp_of(album, own, of[0], verdicts) for of, own in keys.items()}
    there = draw_days(album, stamps, verdicts, pages.fan_out, progress)
    return [render_fleet_page(album, window, verdicts, there, pages.truth), *there.values()]


def _keys_of(album: Album, days: Iterable[Partition]) -> dict[tuple[str, str], list[str]]:
    """Work keys of vehicle-days outside the window."""
    by_day: dict[str, list[str]] = {}
    for partition in days:
        by_day.setdefault(partition.day, []).append(partition.vehicle)
    keys = {}
    for day, vehicles in sorted(by_day.items()):
        records = records_of_day(album.lake, album.method, day, vehicles)
        for vehicle in sorted(records):
            keys[vehicle, day] = [record.work_key for record in records[vehicle].values()]
    return keys
