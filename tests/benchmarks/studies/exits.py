"""Whether short commands end as they should, time after time, on a machine that is busy.

A dozen vehicles of all kinds are audited in a lake of their own; then each command runs many times, in a process of its
own as a car's or a cron job's call does, beside processes that keep the CPUs busy. An exit code that is not the first
run's, or a word on stderr of a process that aborted, is counted.

    python -m tests.benchmarks.studies.exits [--times 200] [--load 4]

A line per command is printed, and added to results/exits.jsonl.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.stages import STATE
from pipeline.store.partitions import Lake
from pipeline.work import Task, Window
from tests.benchmarks.studies.commits import commit_now
from tests.makers.fleet_files import fleet_toml
from tests.makers.fleet_lakes import one_rig_fleet
from tests.makers.large_fleets import some_of_each_kind

RESULTS = Path("tests/benchmarks/results/exits.jsonl")
VEHICLE = "radar-knocked"
BUSY = "while True: pass"


def main() -> int:
    """Run the study; 1 where any run ended otherwise than the first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--load", type=int, default=4, help="processes that keep the CPUs busy meanwhile")
    options = parser.parse_args()
    hogs = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(options.load)]
    try:
        with tempfile.TemporaryDirectory() as folder:
            lines = [_measured(name, c, options.times) for name, c in _commands(Path(folder)).items()]
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
    with RESULTS.open("a") as results:
        for line in lines:
            line |= {"times": options.times, "load": options.load, "commit": commit_now()}
            results.write(json.dumps(line) + "\n")
    return int(any(line["aborted"] or len(line["codes"]) > 1 for line in lines))


def _commands(folder: Path) -> dict[str, list[str]]:
    lake, file, fleet = folder / "lake", folder / "fleet.toml", one_rig_fleet()
    some_of_each_kind(Lake.at(lake), fleet)
    STATE.run(Task(fleet, Lake.at(lake), Window(None, None), "joint"))
    file.write_text(fleet_toml())
    of = ["--lake", str(lake)]
    return {
        "state": ["state", *of, "--json"],
        "show": ["show", "calibrations", *of, "--current", "--json"],
        "status": ["status", *of, "--json"],
        "audit": ["audit", "--fleet", str(file), *of],
        "export": ["export", "urdf", *of, "--vehicle", VEHICLE, "--out", str(folder / "car")],
    }


def _measured(name: str, command: list[str], times: int) -> dict[str, object]:
    began = time.monotonic()
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        runs = list(pool.map(_run, [command] * times))
    codes = Counter(code for code, _ in runs)
    aborted = sum("terminate called" in said or "Fatal Python error" in said for _, said in runs)
    line: dict[str, object] = {"command": name, "codes": dict(codes), "aborted": aborted}
    sys.stdout.write(f"{line}, {time.monotonic() - began:.0f} s\n")
    if len(codes) > 1 or set(codes) - {0, 3}:
        sys.stdout.write(next(said for code, said in runs if code != runs[0][0] or code not in (0, 3)))
    sys.stdout.flush()
    return line


def _run(command: list[str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "jobs.cli", *command], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stderr


if __name__ == "__main__":
    sys.exit(main())
