"""What a night's bookkeeping costs in a lake that is a month or a year old: reading what is known, committing, status.

Records and outcomes of a fleet are made by algebra, tiled over vehicles and days and put into a lake as the night
commits them, a commit per day. Nothing of it touches logs: what a night does beside its vehicle-days is measured.

    python -m tests.benchmarks.studies.lake_age [--vehicles 1000] [--days 30 365]

A line per lake is added to results/lake_age.jsonl; each lake is measured in a process of its own.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.fleet.ledger import Ledger, outcome_row
from pipeline.fleet.status import day_statuses
from pipeline.report.reading import fleet_records
from pipeline.results import Outcome
from pipeline.store.delta import live_files, merge_rows, open_table, stored_schema, tidy_table
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import last_day, read_records
from pipeline.store.rows import to_table
from schemas.calibrations import CALIBRATIONS
from schemas.columns import TableSchema
from schemas.outcomes import OUTCOMES, OutcomeRow
from tests.audit.fleet_records import vehicle_records
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/lake_age.jsonl")
FIRST_DAY = dt.date(2025, 1, 1)
WINDOW_DAYS = 28  # as audit.window_days


def main() -> None:
    """Make and measure each lake, and say what came out."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--days", type=int, nargs="+", default=[30, 365])
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure is not None:
        sys.stdout.write(json.dumps(measure(Lake.at(given.measure), given.vehicles)) + "\n")
        return
    for days in given.days:
        with tempfile.TemporaryDirectory() as folder:
            lake = Lake.at(Path(folder) / "lake")
            began = time.perf_counter()
            fill(lake, given.vehicles, days)
            made_s = time.perf_counter() - began
            command = [sys.executable, "-m", "tests.benchmarks.studies.lake_age", "--measure", str(lake)]
            told = subprocess.run(
                [*command, "--vehicles", str(given.vehicles)], check=True, capture_output=True, text=True
            )
        line = {"vehicles": given.vehicles, "days": days, "commit": commit_now(), "made_s": round(made_s, 1)}
        line |= json.loads(told.stdout)
        sys.stdout.write(json.dumps(line) + "\n")
        with RESULTS.open("a") as file:
            file.write(json.dumps(line) + "\n")


def day_name(index: int) -> str:
    """The index-th day of the lake."""
    return (FIRST_DAY + dt.timedelta(days=index)).isoformat()


def fill(lake: Lake, vehicles: int, days: int) -> None:
    """All days but the last, with the upkeep after each night."""
    records = vehicle_records("v", 1, np.random.default_rng(0))
    outcomes = [
        outcome_row(Outcome(stage, "v", "", "done", "key"), "joint")
        for stage in ("ingest", "perceive", "calibrate")
    ]
    for day in range(days):
        for schema, rows in ((CALIBRATIONS, records), (OUTCOMES, outcomes)):
            merge_rows(lake, schema, tiled(schema, rows, vehicles, day_name(day)))
            for _ in tidy_table(lake, schema):
                pass


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
    with timed("status_of_a_month"):
        first = (dt.date.fromisoformat(last) - dt.timedelta(days=30)).isoformat()
        statuses = day_statuses(read_records(lake, OUTCOMES, OutcomeRow, first=first))
    with timed("records_of_the_window"):
        window = fleet_records(lake, "joint", WINDOW_DAYS)
    files = {s.name: len(live_files(t)) for s in (CALIBRATIONS, OUTCOMES) if (t := open_table(lake, s))}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    counts = {"statuses": len(statuses), "records": len(window)}
    return {"cpu_s": seconds, **counts, "files": files, "peak_mb": round(peak), "lake_mb": lake_mb(lake)}


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
    day = (dt.date.fromisoformat(last) + dt.timedelta(days=1)).isoformat()
    rows = vehicle_records("v", 1, np.random.default_rng(1))
    merge_rows(lake, CALIBRATIONS, tiled(CALIBRATIONS, rows, vehicles, day))


def lake_mb(lake: Lake) -> int:
    """Megabytes on disk, old generations among them."""
    return round(sum(p.stat().st_size for p in lake.local_root.rglob("*") if p.is_file()) / 1e6)


if __name__ == "__main__":
    main()
