"""Study: one network on rigs that it has never seen.

    python -m tests.benchmarks.studies.ssl_cross_rig --root CROSS --models matching=joint.onnx

Two days each of the simulator's rigs: `paper` (Table 1's), `ring16` (16 rows all around, another Doppler sign and
ambiguity), `spin128` (128 rows all around) and `fisheye` (a camera of 190 deg). Networks of `ssl_fleet.py --parts rigs`
have seen none of the four, only rigs drawn from ranges around them. Days that are not there are made first. Priors,
frames and errors are those of ssl_table1.py.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from tests.benchmarks.studies.days import DaySpec, generate_day
from tests.benchmarks.studies.ssl_days import ModelSet, simulated_days
from tests.benchmarks.studies.ssl_table1 import Task, heading, run_tasks
from tests.benchmarks.studies.ssl_tables import abrupt_table, frames_table, rows_of
from tests.benchmarks.studies.table1 import errors_table, verdicts_table

__all__ = ["DAYS", "summary"]

_FRAMES = 40
# Seeds 3900 to 3905 were looked at with the network of 0.7.0 (ssl_cross_rig_070.md).
DAYS = [
    DaySpec(3910 + 2 * i + k, environment, _FRAMES, rig)
    for i, rig in enumerate(("paper", "ring16", "spin128", "fisheye"))
    for k, environment in enumerate(("urban", "highway"))
]


def summary(results: list[dict[str, Any]]) -> str:
    """Tables whose rows are networks on rigs."""
    named = [r | {"method": f"{r['method']} on {r['day']['name'].split('_')[0]}"} for r in results]
    days = [r for r in named if r["part"] == "days"]
    parts = [frames_table([r for r in named if r["part"] == "frames"])]
    parts.append(abrupt_table([r for r in named if r["part"] == "abrupt"], ["abrupt 5"]))
    if days:
        rows = rows_of(days)
        parts += [errors_table(days, "", rows), verdicts_table(days, rows)]
    return "\n\n".join(parts)


def main() -> None:
    """Make the days, measure what is missing, print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="where the days lie or are made")
    parser.add_argument("--models", nargs="*", type=ModelSet.parse, default=[], metavar="NAME=FILE[,..]")
    parser.add_argument(
        "--parts", nargs="+", choices=["frames", "abrupt", "days"], default=["frames", "abrupt", "days"]
    )
    parser.add_argument("--frames", type=int, default=20, help="single frames per day")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/ssl_cross_rig.jsonl"))
    args = parser.parse_args()
    for spec in DAYS:
        began = time.process_time()
        generate_day(spec, args.root, images=True)
        print(f"{spec.name} ({time.process_time() - began:.0f} CPU s)", flush=True)
    tasks = [
        Task(models, where, part, None if part == "days" else args.frames)
        for models in args.models
        for part in args.parts
        for where in simulated_days(args.root, DAYS)
    ]
    results = run_tasks(tasks, args.out, args.workers)
    if results:
        text = f"{heading(results, tasks, args.out.stem)}\n\n{summary(results)}\n"
        args.out.with_suffix(".md").write_text(text)
        print(text)


if __name__ == "__main__":
    main()
