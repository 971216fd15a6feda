"""What a night costs beside its vehicle-days, in a lake that is a month or a year old.

Reading what is known, committing, status, audit, states and the fleet's page, then the pages of the night's
vehicle-days by two workers. Records, outcomes, findings and states of a fleet are made by algebra, a night at a time
with the upkeep that follows a night (`tests/makers/fleet_lakes.py`). Nothing of it touches logs, so pages of
vehicle-days have no pictures.

    python -m tests.benchmarks.studies.lake_age [--vehicles 1000] [--days 30 365] [--lakes FOLDER] [--seconds 200]
        [--undrawn]

A line per lake is added to results/lake_age.jsonl; each lake is measured in a process of its own, and memory is that
of all its processes together. With `--lakes` they stay, and a run that `--seconds` ended goes on where it was; with
`--undrawn` pages of vehicle-days are left out.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil

from pipeline.fleet.ledger import Ledger
from pipeline.fleet.pages import OnWorkers
from pipeline.fleet.status import day_statuses
from pipeline.report.stage import Pages, write_fleet_report
from pipeline.results import Outcome
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, STATE
from pipeline.store.delta import live_files, open_table
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import last_day, read_records
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.states import STATES
from tests.benchmarks.studies.commits import commit_now
from tests.makers.fleet_lakes import FleetHistory, one_rig_fleet

RESULTS = Path("tests/benchmarks/results/lake_age.jsonl")
WORKERS = 2


def main() -> None:
    """Make and measure each lake, and say what came out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--days", type=int, nargs="+", default=[30, 365])
    parser.add_argument("--lakes", type=Path)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--undrawn", action="store_true")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure is not None:
        told = measure(Lake.at(given.measure), FleetHistory(given.vehicles, given.days[0]), given.undrawn)
        sys.stdout.write(json.dumps(told) + "\n")
        return
    until = time.monotonic() + given.seconds
    with tempfile.TemporaryDirectory() as folder:
        for days in given.days:
            lake = Lake.at((given.lakes or Path(folder)) / f"{given.vehicles}_{days}")
            if not fill(lake, FleetHistory(given.vehicles, days), until):
                sys.stdout.write(f"{lake} is filled until {last_day(lake, STATES)}: run it again\n")
                return
            copy = Path(folder) / "measured"  # which adds nights
            shutil.copytree(lake.local_root, copy)
            STATE.run(Task(one_rig_fleet(), Lake.at(copy), Window()))  # the night before kept references
            line = {"vehicles": given.vehicles, "days": days, "commit": commit_now()}
            line |= measured_apart(copy, given.vehicles, days, given.undrawn)
            shutil.rmtree(copy)
            sys.stdout.write(json.dumps(line) + "\n")
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")


def measured_apart(copy: Path, vehicles: int, days: int, undrawn: bool) -> dict[str, Any]:
    """What a process of its own measures."""
    command = [sys.executable, "-m", "tests.benchmarks.studies.lake_age", "--measure", str(copy)]
    command += ["--vehicles", str(vehicles), "--days", str(days), *(["--undrawn"] if undrawn else [])]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, Any] = json.loads(told.stdout.splitlines()[-1])
    return found


def fill(lake: Lake, history: FleetHistory, until: float) -> bool:
    """Fill a lake with all of its nights; False where the time ended first."""
    filled = last_day(lake, STATES)  # the last table of a night
    begin = 0 if filled is None else (dt.date.fromisoformat(filled) - history.begin).days + 1
    for index in range(begin, history.days):
        if time.monotonic() > until:
            return False
        history.commit_night(lake, index)
    return True


def measure(lake: Lake, history: FleetHistory, undrawn: bool = False) -> dict[str, Any]:
    """Seconds of everything that a night does beside its vehicle-days, and the memory that it took."""
    last = last_day(lake, CALIBRATIONS)
    assert last == history.day_name(history.days - 1), "the lake was just filled"
    today = [Partition(name, last) for name in history.names.tolist()]
    seconds: dict[str, float] = {}
    wall: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        began, at = time.process_time(), time.perf_counter()
        yield
        seconds[name] = round(time.process_time() - began, 3)
        wall[name] = round(time.perf_counter() - at, 3)

    fleet = one_rig_fleet()
    pages = Pages(lake.root / "report" / "fleet.html", fan_out=touching)
    with peak_of_all_processes() as peak:
        with timed("known_of_the_night"):
            ledger = Ledger(lake, today)
        with timed("a_cached_night_in_the_driver"):
            cached_night(ledger, today)
        write_fleet_report(lake, fleet, pages)  # the nights before drew the window's pages
        with timed("commit_of_a_night"):
            history.commit(lake, CALIBRATIONS, history.days, merge=True)
            history.commit(lake, OUTCOMES, history.days, merge=True)
        with timed("status_of_a_month"):
            first = (history.begin + dt.timedelta(days=history.days - 30)).isoformat()
            statuses = day_statuses(read_records(lake, OUTCOMES, OutcomeRow, first=first))
        task = Task(fleet, lake, Window())
        with timed("audit"):
            findings = AUDIT.run(task).records
        with timed("states"):
            STATE.run(task)
        drawing = Drawing(0 if undrawn else WORKERS)
        with timed("pages_but_drawing_days"):
            written = write_fleet_report(lake, fleet, replace(pages, fan_out=drawing))
    seconds["pages_but_drawing_days"] -= drawing.driver_s
    wall["pages_but_drawing_days"] -= drawing.wall_s
    tables = (CALIBRATIONS, OUTCOMES, DRIFT, STATES)
    files = {s.name: len(live_files(t)) for s in tables if (t := open_table(lake, s))}
    return {
        "cpu_s": {name: round(value, 3) for name, value in seconds.items()},
        "total_s": round(sum(seconds.values()), 2),
        "wall_s": round(sum(wall.values()), 2),
        "drawn": drawing.pages,
        "drawing_wall_s": round(drawing.wall_s, 2),
        "drawing_cpu_s": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime + drawing.driver_s, 2),
        "all_wall_s": round(sum(wall.values()) + drawing.wall_s, 2),
        "statuses": len(statuses),
        "findings": len(findings),
        "red": len({f.vehicle for f in findings if f.vehicle_status == "RED"}),
        "pages": len(written),
        "files": files,
        "peak_mb": peak(),
        "lake_mb": lake_mb(lake),
    }


@dataclass
class Drawing:
    """Draws pages of vehicle-days by so many workers (0: leaves them out), and says what that took."""

    workers: int
    pages: int = 0
    wall_s: float = 0.0
    driver_s: float = 0.0

    def __call__(self, function: Any, jobs: Any, progress: Any) -> Iterator[tuple[Any, Any, str]]:
        """See `pipeline.report.upkeep.FanOut`."""
        began, at = time.process_time(), time.perf_counter()
        fan_out = OnWorkers("process", self.workers) if self.workers else touching
        for end in fan_out(function, jobs, progress):
            assert not end[2], end[2]
            self.pages += 1
            yield end
        self.driver_s, self.wall_s = time.process_time() - began, time.perf_counter() - at


def touching(function: Any, jobs: Any, progress: Any) -> Iterator[tuple[Any, Any, str]]:
    """Where pages of days are drawn: here an empty file takes a page's place, for days that were drawn before."""
    del function, progress
    for job in jobs:
        path = Path(job.album.path(job.partition.vehicle, job.partition.day))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        yield job, [], ""


@contextmanager
def peak_of_all_processes() -> Iterator[Callable[[], int]]:
    """Largest resident memory of this process and its children together [MB], looked at ten times a second."""
    most, done, here = [0], threading.Event(), psutil.Process()

    def watch() -> None:
        while not done.wait(0.1):
            total = 0
            for process in [here, *here.children(recursive=True)]:
                with suppress(psutil.NoSuchProcess):
                    total += process.memory_info().rss
            most[0] = max(most[0], total)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield lambda: round(most[0] / 2**20)
    finally:
        done.set()
        watcher.join()


def cached_night(ledger: Ledger, days: list[Partition]) -> None:
    """Every vehicle-day says that there was nothing to do."""
    for partition in days:
        known = ledger.known(partition)
        if not known.records:  # the vehicle has not joined yet
            continue
        key = known.records[-1].work_key
        for stage in ("ingest", "perceive"):
            ledger.add(Outcome(stage, partition.vehicle, partition.day, "cached", key), "joint")
        ledger.add(
            Outcome("calibrate", partition.vehicle, partition.day, "cached", key, records=known.records),
            "joint",
        )
    ledger.commit()


def lake_mb(lake: Lake) -> int:
    """Megabytes on disk, old generations among them."""
    return round(sum(p.stat().st_size for p in lake.local_root.rglob("*") if p.is_file()) / 1e6)


if __name__ == "__main__":
    main()
