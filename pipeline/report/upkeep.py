"""Pages of vehicle-days kept up to date: selection of outdated pages, and drawing them, here or by workers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import quote

from pipeline.core.config import FleetConfig, config_hash
from pipeline.core.results import MadeWhenAsked, Progress, silent
from pipeline.report.day_page import DayRead, write_day_page
from pipeline.report.page import page_stem
from pipeline.report.reading import records_of_day
from pipeline.report.verdicts import FleetVerdicts
from pipeline.store.current import current_states
from pipeline.store.files import Files
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_last
from schemas.calibrations import CalibrationRecord
from schemas.drift import status_of
from schemas.states import STATES, StateRow
from schemas.versions import CODE_VERSION

__all__ = ["Album", "DayJob", "FanOut", "draw_days", "one_by_one", "stamp_of"]

_DRAWN = "drawn.json"  # of each day's folder: what its pages were drawn from, by file name


# Runs a function on many items, here or elsewhere: (item, value, error) of each, in any order.
FanOut = Callable[[Callable[[Any, Progress], Any], Sequence[Any], Progress], Iterator[tuple[Any, Any, str]]]


def one_by_one(
    function: Callable[[Any, Progress], Any], items: Sequence[Any], progress: Progress
) -> Iterator[tuple[Any, Any, str]]:
    """Apply a function to all items in this process; an error stops the rest."""
    for done, item in enumerate(items):
        progress(done, len(items), str(item))
        yield item, function(item, silent), ""


@dataclass(frozen=True)
class Album:
    """The pages of a report's vehicle-days: `LAKE/report/fleet_days/2026-03-01/car-1.html`.

    Args:
        page: the fleet page, next to the folder of day pages.
        files: storage of the fleet page.
        pictures: False = pages without images of public roads.
    """

    lake: Lake
    fleet: FleetConfig
    method: str
    page: PurePath
    files: Files
    pictures: bool = True

    @property
    def folder(self) -> PurePath:
        """Folder of the pages."""
        return self.page.parent / f"{self.page.stem}_days"

    def path(self, vehicle: str, day: str) -> PurePath:
        """A vehicle-day's page."""
        return self.folder / day / f"{page_stem(vehicle)}.html"


@dataclass(frozen=True)
class DayJob:
    """A page to draw, with all inputs of a worker."""

    album: Album
    partition: Partition
    read: DayRead = field(repr=False)

    def __str__(self) -> str:
        return f"{self.partition.vehicle} {self.partition.day}"


def draw_days(
    album: Album,
    stamps: Mapping[tuple[str, str], str],
    verdicts: FleetVerdicts,
    fan_out: FanOut,
    progress: Progress,
) -> dict[tuple[str, str], PurePath]:
    """Draw missing pages, and pages drawn from other inputs; returns all pages that exist then.

    `lake.damage` lists pages that could not be drawn.

    Args:
        stamps: inputs of each vehicle-day's page (`stamp_of`).
        verdicts: of the last audit.
        fan_out: executor that draws the pages.
    """
    by_day: dict[str, dict[str, str]] = {}
    for (vehicle, day), stamp in stamps.items():
        by_day.setdefault(day, {})[vehicle] = stamp
    drawn = {day: _drawn(album, day) for day in by_day}
    stale = [
        (vehicle, day)
        for day, vehicles in sorted(by_day.items())
        for vehicle, stamp in sorted(vehicles.items())
        if drawn[day].get(album.path(vehicle, day).name) != stamp
    ]
    open_pages = Counter(day for _, day in stale)
    jobs = _jobs(album, stale, verdicts)
    for job, found, error in fan_out(_draw, jobs, progress):
        vehicle, day = job.partition.vehicle, job.partition.day
        album.lake.damage.extend([f"page of {job}: {error}"] if error else found)
        if not error and job.read.records:
            drawn[day][album.path(vehicle, day).name] = stamps[vehicle, day]
        open_pages[day] -= 1
        if not open_pages[day]:  # a killed night draws the day's pages once more
            with album.files.replacing(album.folder / day / _DRAWN) as stream:
                stream.write(json.dumps(drawn[day], sort_keys=True).encode())
    there = {(v, day): album.path(v, day) for v, day in sorted(stamps)}
    return {of: path for of, path in there.items() if path.name in drawn[of[1]]}


def stamp_of(album: Album, work_keys: Iterable[str], vehicle: str, verdicts: FleetVerdicts) -> str:
    """Inputs of a day's page; it is drawn again if they changed.

    A sensor that moved is included, because it invalidates the numbers of days before.
    """
    stored = status_of(verdicts.findings.get(vehicle, ()))
    moved = [stored.sensor, stored.since] if stored.status == "RED" else None
    shown = album.fleet.report.model_dump() if album.pictures else None
    mend = verdicts.corrections.get(vehicle, "")
    settings = {"pictures": shown, "link": album.page.name, "code": CODE_VERSION}
    return config_hash({"keys": sorted(work_keys), "moved": moved, "mend": mend, **settings})


def _drawn(album: Album, day: str) -> dict[str, str]:
    """Inputs of the day's existing pages."""
    folder = album.folder / day
    known: dict[str, str] = {}
    with suppress(OSError, ValueError), album.files.opened(folder / _DRAWN) as stream:
        known = json.loads(stream.read())
    there = {path.name for path in album.files.find(folder, "*.html")} if known else set()
    return {name: stamp for name, stamp in known.items() if name in there}


def _draw(job: DayJob, progress: Progress) -> list[str]:
    """Draw one page; returns files that could not be read for it."""
    progress(0, 1, str(job))
    album = job.album
    if not job.read.records:  # its file went bad meanwhile: whoever read it has said so
        return []
    link = f"../../{quote(album.page.name)}"
    path = album.path(job.partition.vehicle, job.partition.day)
    before = len(album.lake.damage)
    write_day_page(
        album.lake, job.partition, album.fleet, path, album.method,
        fleet_link=link, pictures=album.pictures, read=job.read, files=album.files,
    )  # fmt: skip
    found = album.lake.damage[before:]
    del album.lake.damage[before:]
    return found


def _jobs(album: Album, vehicle_days: Sequence[tuple[str, str]], verdicts: FleetVerdicts) -> Sequence[DayJob]:
    """Pages to draw; records are read a day at a time."""
    # A worker is sent no vehicle's configuration: a page needs the fleet's name. It may be elsewhere, too.
    fleet = album.fleet.model_copy(update={"vehicles": {}, "rigs": {}})
    page = album.page.absolute() if isinstance(album.page, Path) else album.page
    sent = replace(album, lake=album.lake.absolute(), fleet=fleet, page=page)

    states: dict[str, list[StateRow]] = {}
    for row in current_states(read_last(sent.lake, STATES, StateRow, sent.method)):
        states.setdefault(row.vehicle, []).append(row)

    @lru_cache(maxsize=2)  # workers end a day while others begin the next
    def records(day: str) -> dict[str, dict[str, CalibrationRecord]]:
        among = {vehicle for vehicle, of in vehicle_days if of == day}
        return records_of_day(sent.lake, sent.method, day, among)

    def job(index: int) -> DayJob:
        vehicle, day = vehicle_days[index]
        found, mend = verdicts.findings.get(vehicle, ()), verdicts.corrections.get(vehicle, "")
        read = DayRead(records(day).get(vehicle, {}), found, states.get(vehicle, ()), mend)
        return DayJob(sent, Partition(vehicle, day), read)

    return MadeWhenAsked(len(vehicle_days), job)
