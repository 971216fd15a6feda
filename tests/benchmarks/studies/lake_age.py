"""What a night costs beside its vehicle-days, in a lake that is a month or a year old.

Reading what is known, committing, status, audit, states and the fleet's page. Records, outcomes, findings and states
of a fleet are made by algebra, tiled over vehicles and days and put into a lake: ten days at a time, the last month a
night at a time, with the upkeep that follows a night. Nothing of it touches logs, and no page of a vehicle-day is
drawn (0.9 s each).

    python -m tests.benchmarks.studies.lake_age [--vehicles 1000] [--days 30 365] [--lakes FOLDER] [--seconds 200]

A line per lake is added to results/lake_age.jsonl; each lake is measured in a process of its own. With `--lakes` they
stay, and a run that `--seconds` ended goes on where it was.
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
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.config import FleetConfig
from pipeline.fleet.ledger import Ledger, outcome_row
from pipeline.fleet.status import day_statuses
from pipeline.report.stage import Pages, write_fleet_report
from pipeline.results import Outcome
from pipeline.stages import AUDIT, STATE
from pipeline.store.delta import live_files, merge_rows, open_table, stored_schema, tidy_table
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import commit_records, last_day, read_records
from pipeline.store.rows import to_table
from pipeline.work import Task, Window
from schemas.calibrations import CALIBRATIONS
from schemas.columns import TableSchema
from schemas.drift import DRIFT, DriftFinding
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.states import STATES, StateRow
from tests.audit.fleet_records import vehicle_records
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/lake_age.jsonl")
FIRST_DAY = dt.date(2025, 1, 1)
WINDOW_DAYS = 28  # as audit.window_days
AT_ONCE = 10  # days of a commit before the last month


def main() -> None:
    """Make and measure each lake, and say what came out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--days", type=int, nargs="+", default=[30, 365])
    parser.add_argument("--lakes", type=Path)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure is not None:
        sys.stdout.write(json.dumps(measure(Lake.at(given.measure), given.vehicles)) + "\n")
        return
    until = time.monotonic() + given.seconds
    with tempfile.TemporaryDirectory() as folder:
        for days in given.days:
            lake = Lake.at((given.lakes or Path(folder)) / f"{given.vehicles}_{days}")
            if not fill(lake, given.vehicles, days, until):
                sys.stdout.write(f"{lake} is filled until {last_day(lake, STATES)}: run it again\n")
                return
            copy = Path(folder) / "measured"  # which adds nights
            shutil.copytree(lake.local_root, copy)
            command = [sys.executable, "-m", "tests.benchmarks.studies.lake_age", "--measure", str(copy)]
            told = subprocess.run(
                [*command, "--vehicles", str(given.vehicles)], check=True, capture_output=True, text=True
            )
            shutil.rmtree(copy)
            line = {"vehicles": given.vehicles, "days": days, "commit": commit_now()}
            line |= json.loads(told.stdout.splitlines()[-1])
            sys.stdout.write(json.dumps(line) + "\n")
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")


def day_name(index: int) -> str:
    """The index-th day of the lake."""
    return (FIRST_DAY + dt.timedelta(days=index)).isoformat()


def fill(lake: Lake, vehicles: int, days: int, until: float) -> bool:
    """Fill a lake with all of its days, with the upkeep after each commit; False where the time ended first."""
    filled = last_day(lake, STATES)  # the last table of a commit
    begin = 0 if filled is None else (dt.date.fromisoformat(filled) - FIRST_DAY).days + 1
    findings, states = audited()
    outcomes = [
        outcome_row(Outcome(stage, "v", "", "done", "key"), "joint")
        for stage in ("ingest", "perceive", "calibrate")
    ]
    while begin < days:
        if time.monotonic() > until:
            return False
        count = AT_ONCE if begin + AT_ONCE <= days - 31 else 1
        names = [day_name(begin + k) for k in range(count)]
        records = [vehicle_records("v", 1, np.random.default_rng(begin + k)) for k in range(count)]
        for schema, rows in (
            (CALIBRATIONS, records),
            (OUTCOMES, [outcomes] * count),
            (DRIFT, [findings] * count),
            (STATES, [states] * count),
        ):
            parts = [tiled(schema, own, vehicles, day) for own, day in zip(rows, names, strict=True)]
            merge_rows(lake, schema, pa.concat_tables(parts))
            for _ in tidy_table(lake, schema):
                pass
        begin += count
    return True


def audited() -> tuple[list[DriftFinding], list[StateRow]]:
    """What an audit and a state say of one vehicle after a window of days."""
    with tempfile.TemporaryDirectory() as folder:
        lake = Lake.at(folder)
        commit_records(lake, CALIBRATIONS, vehicle_records("v", WINDOW_DAYS, np.random.default_rng(0)))
        task = Task(fleet(), lake, Window())
        return list(AUDIT.run(task).records), list(STATE.run(task).records)


def fleet() -> FleetConfig:
    """A fleet.toml of one rig; its vehicles are those that have records."""
    semantics = {"source": "topics", "labels": "/l", "detections": "/d"}
    camera = {"image": "/i", "info": "/c", "semantics": semantics}
    rig = {"camera": camera, "lidar": {"points": "/p"}, "radar": {"points": "/r"}}
    return FleetConfig.model_validate({"fleet": {"name": "study"}, "rigs": {"default": rig}})


def tiled(schema: TableSchema, rows: list[Any], vehicles: int, day: str) -> pa.Table:
    """The rows of one vehicle-day, for every vehicle."""
    stamp = f"{day}T23:00:00.000000Z"
    table = to_table([replace(r, day=day, recorded_at=stamp, asserted_at=stamp) for r in rows], schema)
    table = table.append_column("month", pa.array([day[:7]] * len(rows)))
    whole = pa.concat_tables([table] * vehicles)
    names = [f"vehicle-{v:05d}" for v in range(vehicles) for _ in rows]
    for column, values in (("vehicle", names), ("work_key", [f"{name}-{day}" for name in names])):
        at = whole.schema.get_field_index(column)
        whole = whole.set_column(at, whole.schema.field(column), pa.array(values))
    return whole.cast(stored_schema(schema))


def measure(lake: Lake, vehicles: int) -> dict[str, Any]:
    """Seconds of everything that a night does beside its vehicle-days, and the memory that it took."""
    last = last_day(lake, CALIBRATIONS)
    assert last is not None, "the lake was just filled"
    today = [Partition(f"vehicle-{v:05d}", last) for v in range(vehicles)]
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        began = time.process_time()
        yield
        seconds[name] = round(time.process_time() - began, 3)

    with timed("known_of_the_night"):
        ledger = Ledger(lake, today)
    with timed("a_cached_night_in_the_driver"):
        cached_night(ledger, today)
    with timed("commit_of_a_night"):
        commit_of(lake, vehicles, last)
    last = day_after(last)
    with timed("status_of_a_month"):
        first = (dt.date.fromisoformat(last) - dt.timedelta(days=30)).isoformat()
        statuses = day_statuses(read_records(lake, OUTCOMES, OutcomeRow, first=first))
    pages = Pages(lake.root / "report" / "fleet.html", fan_out=touching)
    write_fleet_report(lake, fleet(), pages)  # the nights before drew the window's pages
    commit_of(lake, vehicles, last)
    task = Task(fleet(), lake, Window())
    with timed("audit"):
        findings = AUDIT.run(task).records
    with timed("states"):
        STATE.run(task)
    drawn = set()
    with timed("pages_but_drawing_days"):
        written = write_fleet_report(lake, fleet(), replace(pages, fan_out=partial(touching, told=drawn)))
    tables = (CALIBRATIONS, OUTCOMES, DRIFT, STATES)
    files = {s.name: len(live_files(t)) for s in tables if (t := open_table(lake, s))}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    counts = {
        "statuses": len(statuses),
        "findings": len(findings),
        "pages": len(written),
        "drawn": len(drawn),
    }
    total = round(sum(seconds.values()), 2)
    return {
        "cpu_s": seconds,
        "total_s": total,
        **counts,
        "files": files,
        "peak_mb": round(peak),
        "lake_mb": lake_mb(lake),
    }


def touching(
    function: Any, jobs: Any, progress: Any, told: set[str] | None = None
) -> Iterator[tuple[Any, Any, str]]:
    """Where pages of days are drawn: here an empty file takes a page's place, since a page is a vehicle-day's cost."""
    del function, progress
    for job in jobs:
        path = Path(job.album.path(job.partition.vehicle, job.partition.day))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        (told if told is not None else set()).add(str(path))
        yield job, [], ""


def cached_night(ledger: Ledger, days: list[Partition]) -> None:
    """Every vehicle-day says that there was nothing to do."""
    for partition in days:
        known = ledger.known(partition)
        calibrated = Outcome(
            "calibrate",
            partition.vehicle,
            partition.day,
            "cached",
            known.records[-1].work_key,
            records=known.records,
        )
        for stage in ("ingest", "perceive"):
            ledger.add(
                Outcome(stage, partition.vehicle, partition.day, "cached", calibrated.work_key), "joint"
            )
        ledger.add(calibrated, "joint")
    ledger.commit()


def commit_of(lake: Lake, vehicles: int, last: str) -> None:
    """The next day of the whole fleet, in one commit."""
    rows = vehicle_records("v", 1, np.random.default_rng(1))
    merge_rows(lake, CALIBRATIONS, tiled(CALIBRATIONS, rows, vehicles, day_after(last)))


def day_after(day: str) -> str:
    """The next day of the calendar."""
    return (dt.date.fromisoformat(day) + dt.timedelta(days=1)).isoformat()


def lake_mb(lake: Lake) -> int:
    """Megabytes on disk, old generations among them."""
    return round(sum(p.stat().st_size for p in lake.local_root.rglob("*") if p.is_file()) / 1e6)


if __name__ == "__main__":
    main()
