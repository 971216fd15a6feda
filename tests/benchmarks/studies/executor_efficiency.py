"""How well two workers are used on real vehicle-days, in a pool of processes and on Ray.

    boresight simulate --out DAYS --vehicles 6 --days 1 --frames 80 --seed N
    python -m tests.benchmarks.studies.executor_efficiency --fleet DAYS/fleet.toml --logs "DAYS/logs/{vehicle}/{day}/*"

Whole nights (the installed command, logs to pages) on fresh lakes: inline, in a pool of two processes, on a Ray cluster
of this machine with two workers, one after the other, round by round. A line per night is added to
results/executor_efficiency.jsonl; the last lines printed are the table.

Efficiency is by the clock: the seconds of the inline night over twice those of a night with two workers. On a machine
that is not quiet it is a lower bound: the kernel counts how long a process was ready to run and had no CPU
(/proc/PID/schedstat); what a night's workers so waited in the mean is printed beside it, and what the efficiency would
be without it. That is no measurement of a quiet machine, whose caches and clock rates nobody knows here.
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
    parser.add_argument("--executors", nargs="*", choices=dict(WAYS), default=list(dict(WAYS)))
    args = parser.parse_args()
    for _ in range(args.rounds):
        for executor, workers in [way for way in WAYS if way[0] in args.executors]:
            line = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "executor": executor}
            line |= {"workers": workers} | night(args.fleet, args.logs, executor, workers)
            sys.stdout.write(json.dumps(line) + "\n")
            with RESULTS.open("a") as file:
                file.write(json.dumps(line) + "\n")
    sys.stdout.write(table([json.loads(line) for line in RESULTS.read_text().splitlines()]))


def night(fleet: str, logs: str, executor: str, workers: int) -> dict[str, Any]:
    """One night on a fresh lake: seconds by the clock, of its processes, and those that its workers had no CPU."""
    with tempfile.TemporaryDirectory() as lake:
        command = [f"{sys.prefix}/bin/boresight", "nightly", "--fleet", fleet, "--lake", lake, "--logs", logs]
        command += ["--executor", executor, "--workers", str(workers)]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment.pop("RAY_ADDRESS", None)
        began = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
        spent: dict[int, tuple[float, float]] = {}
        while process.poll() is None:
            spent |= _spent_s(process.pid)
            time.sleep(_LOOK_S)
        wall_s = time.perf_counter() - began
        out, _ = process.communicate()
    told = json.loads(out.splitlines()[-1])
    assert told["failed"] == 0, told
    waited_s = statistics.mean(waited for _, waited in sorted(spent.values())[-workers:])
    return {
        "vehicle_days": told["vehicle_days"],
        "wall_s": round(wall_s, 1),
        "cpu_s": round(sum(cpu for cpu, _ in spent.values()), 1),
        "waited_s": round(waited_s, 1),
        "alone_s": round(wall_s - waited_s, 1),
    }


def table(lines: list[dict[str, Any]]) -> str:
    """Of the shortest of each executor's nights by the clock, by how many vehicle-days these had."""
    nights: dict[int, dict[str, list[dict[str, Any]]]] = {}
    for line in lines:
        nights.setdefault(line["vehicle_days"], {}).setdefault(line["executor"], []).append(line)
    return "".join(f"{days} vehicle-days: {_row(of)}\n" for days, of in sorted(nights.items()))


def _row(of: dict[str, list[dict[str, Any]]]) -> str:
    best = {way: min(of[way], key=lambda line: line["wall_s"]) for way, _ in WAYS if way in of}
    told = [
        f"{way} {night['wall_s']:.1f} s, {night['waited_s']:.1f} of them waited ({len(of[way])} nights)"
        for way, night in best.items()
    ]
    pooled = [way for way, workers in WAYS if workers == 2 and way in best]
    if "inline" in best:
        told += [
            f"efficiency of {way} {_share(best, way, 'wall_s'):.2f} by the clock ({_share(best, way, 'alone_s'):.2f})"
            for way in pooled
        ]
    if len(pooled) == 2:
        told.append(f"ray against process {best['process']['wall_s'] / best['ray']['wall_s']:.2f}")
    return ", ".join(told)


def _share(best: dict[str, dict[str, Any]], way: str, seconds: str) -> float:
    return float(best["inline"][seconds] / 2 / best[way][seconds])


def _spent_s(session: int) -> dict[int, tuple[float, float]]:
    """Of each process of a session so far: CPU seconds, and those that its first thread was ready and had no CPU."""
    found = {}
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if os.getsid(process.pid) == session:
                waited_ns = int(Path(f"/proc/{process.pid}/schedstat").read_text().split()[1])
                found[process.pid] = sum(process.cpu_times()[:2]), waited_ns / 1e9
    return found


if __name__ == "__main__":
    main()
