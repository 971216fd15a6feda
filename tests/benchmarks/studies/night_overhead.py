"""What a night costs for a vehicle-day that is up to date, and for one that was refused before: CPU of a worker.

A simulated vehicle-day of a few frames and a poisoned log are taken through the night once, and then again and again.
Beside its logs' identity (samples of the content: of small logs all of it) nothing of the day is read.

    python -m tests.benchmarks.studies.night_overhead [--times 50]

A line is added to results/night_overhead.jsonl.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from pipeline.config import load_fleet
from pipeline.fleet.ledger import Ledger
from pipeline.fleet.nightly import Night, run_night, run_vehicle_day
from pipeline.fleet.pattern import find_vehicle_days
from pipeline.results import silent
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.store.partitions import Lake
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/night_overhead.jsonl")


def main() -> None:
    """Run the night, then measure the next."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=50)
    times = parser.parse_args().times
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        make_fleet(out)
        night = Night(load_fleet(out / "fleet.toml"), Lake.at(out / "lake"))
        days = find_vehicle_days(str(out / "logs/{vehicle}/{day}/*"))
        for _ in run_night(night, days, "inline", 1, lambda *_: None):
            pass
        ledger = Ledger(night.lake, [d.partition for d in days])
        line = {"commit": commit_now(), "times": times}
        for day in days:
            known = ledger.known(day.partition)
            outcome = run_vehicle_day(night, day, known, silent)
            began = time.process_time()
            for _ in range(times):
                run_vehicle_day(night, day, known, silent)
            ms = (time.process_time() - began) / times * 1e3
            stages = {r.stage: r.status for r in outcome.results}
            size = sum(
                p.stat().st_size for log in day.logs for p in ([log] if log.is_file() else log.rglob("*"))
            )
            line[day.partition.vehicle] = {"stages": stages, "cpu_ms": round(ms, 2), "log_bytes": size}
    sys.stdout.write(json.dumps(line) + "\n")
    with RESULTS.open("a") as file:
        file.write(json.dumps(line) + "\n")


def make_fleet(out: Path) -> None:
    """A good vehicle-day, and one whose log is poisoned."""
    simulate_fleet(FleetSpec(vehicles=1, days=1, frames=12, drives=2), out)
    [day] = (out / "logs" / "vehicle-1").iterdir()
    poisoned = out / "logs" / "vehicle-2" / day.name
    poisoned.mkdir(parents=True)
    (poisoned / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)) * 100)
    with (out / "fleet.toml").open("a") as file:
        file.write('\n[vehicles."vehicle-2"]\nrig = "demo"\n')


if __name__ == "__main__":
    main()
