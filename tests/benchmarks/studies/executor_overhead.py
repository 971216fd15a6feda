"""What an executor adds to a vehicle-day: a thousand items of a vehicle-day's size on which nothing is done.

    python -m tests.benchmarks.studies.executor_overhead

A line per executor is added to results/executor_overhead.jsonl: seconds until the first items have ended, then wall
clock and the driver's CPU per item, with two workers on this machine.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from pipeline.fleet.executor import EXECUTORS
from pipeline.results import Progress
from tests.benchmarks.studies import executor_overhead  # workers find the function by its module's name
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/executor_overhead.jsonl")
ITEMS, WORKERS = 1000, 2
# A vehicle-day with its rig and what the lake has of it, pickled.
ITEM_BYTES = 5000


def nothing(item: Any, progress: Progress) -> Any:
    """The item."""
    del progress
    return item


def main() -> None:
    """Measure every executor."""
    item = "x" * ITEM_BYTES
    for name, run in EXECUTORS.items():
        began = time.perf_counter()
        list(run(executor_overhead.nothing, [item] * WORKERS, WORKERS, lambda *_: None))
        start_s = time.perf_counter() - began
        began, cpu = time.perf_counter(), time.process_time()
        ends = list(run(executor_overhead.nothing, [item] * ITEMS, WORKERS, lambda *_: None))
        assert not any(end.error for end in ends), ends[0]
        line = {
            "executor": name,
            "commit": commit_now(),
            "start_s": round(start_s, 1),
            "wall_ms": round((time.perf_counter() - began) / ITEMS * 1e3, 2),
            "driver_cpu_ms": round((time.process_time() - cpu) / ITEMS * 1e3, 2),
        }
        sys.stdout.write(json.dumps(line) + "\n")
        with RESULTS.open("a") as file:
            file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
