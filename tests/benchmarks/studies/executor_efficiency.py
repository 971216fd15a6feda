"""How well two workers are used on real vehicle-days, in a pool of processes and on Ray.

    boresight simulate --out DAYS --vehicles 6 --days 1 --frames 80 --seed N
    python -m tests.benchmarks.studies.executor_efficiency --fleet DAYS/fleet.toml --logs "DAYS/logs/{vehicle}/{day}/*"

Whole nights (the installed command, logs to pages) on fresh lakes: inline, in a pool of two processes, on a Ray cluster
of this machine with two workers, one after the other, round by round. A line per night is added to
results/executor_efficiency.jsonl; the last lines printed are the table.

The machine need not be quiet: a line has what other processes took meanwhile (from /proc/stat, less what the night's
own processes took), and a night is measured by the CPU seconds that were left to it: CPUs times wall clock less what
others took. Efficiency is what the inline night computed, over what was left to a night with two workers.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from tests.benchmarks.studies.commits import commit_now

RESULTS = Path("tests/benchmarks/results/executor_efficiency.jsonl")
WAYS = (("inline", 1), ("process", 2), ("ray", 2))
_LOOK_S = 0.25  # between two looks at what the night's processes have taken


def main() -> None:
    """Run the rounds and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fleet", required=True)
    parser.add_argument("--logs", required=True)
    parser.add_argument("--rounds", type=int, default=1)
    args = parser.parse_args()
    for _ in range(args.rounds):
        for executor, workers in WAYS:
            line = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "executor": executor}
            line |= {"workers": workers} | night(args.fleet, args.logs, executor, workers)
            sys.stdout.write(json.dumps(line) + "\n")
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")
    sys.stdout.write(table([json.loads(line) for line in RESULTS.read_text().splitlines()]))


def night(fleet: str, logs: str, executor: str, workers: int) -> dict[str, Any]:
    """One night on a fresh lake: seconds by the clock, of its own processes and of others'."""
    with tempfile.TemporaryDirectory() as lake:
        command = [f"{sys.prefix}/bin/boresight", "nightly", "--fleet", fleet, "--lake", lake, "--logs", logs]
        command += ["--executor", executor, "--workers", str(workers)]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment.pop("RAY_ADDRESS", None)
        began, busy = time.perf_counter(), _busy_s()
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
        taken: dict[int, float] = {}
        while process.poll() is None:
            taken |= _taken_s(process.pid)
            time.sleep(_LOOK_S)
        wall_s, busy = time.perf_counter() - began, _busy_s() - busy
        out, _ = process.communicate()
    told = json.loads(out.splitlines()[-1])
    assert told["failed"] == 0, told
    own_s = sum(taken.values())
    cpus = len(os.sched_getaffinity(0))
    return {
        "vehicle_days": told["vehicle_days"],
        "cpus": cpus,
        "wall_s": round(wall_s, 1),
        "own_cpu_s": round(own_s, 1),
        "others_cpu_s": round(max(busy - own_s, 0.0), 1),
        "left_s": round(cpus * wall_s - max(busy - own_s, 0.0), 1),
    }


def table(lines: list[dict[str, Any]]) -> str:
    """Medians over the rounds."""
    of = {way: [line for line in lines if line["executor"] == way] for way, _ in WAYS}
    work_s = statistics.median(line["own_cpu_s"] for line in of["inline"])
    left_s = {way: statistics.median(line["left_s"] for line in of[way]) for way in ("process", "ray")}
    rows = [
        f"{way}: efficiency {work_s / left:.2f} ({len(of[way])} nights)\n" for way, left in left_s.items()
    ]
    return "".join(rows) + f"ray against process: {left_s['process'] / left_s['ray']:.2f}\n"


def _taken_s(session: int) -> dict[int, float]:
    """CPU seconds of each process of a session so far."""
    found = {}
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == session:
                found[process.pid] = sum(process.cpu_times()[:2])
    return found


def _busy_s() -> float:
    """CPU seconds that all processes of the machine have taken."""
    times = psutil.cpu_times()
    return float(times.user + times.nice + times.system + times.irq + times.softirq)


if __name__ == "__main__":
    main()
