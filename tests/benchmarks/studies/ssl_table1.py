"""Study: networks on the days of Table 1, frame by frame, after abrupt changes, and as records of whole days.

    python -m tests.benchmarks.studies.ssl_table1 --root SSL/table1 --models matching=joint.onnx \
        concat=joint_concat.onnx pairwise=camera_lidar.onnx,camera_radar.onnx,lidar_radar.onnx
    python -m tests.benchmarks.studies.ssl_table1 --root SSL/fleet --tuning --models matching=joint.onnx --out FILE

Priors are those of table1.py: the truth turned by exactly 2 deg and shifted by exactly 0.2 m, each frame of the
single-frame part by another draw; sensors knocked by 2, 5 and 10 deg are shifted by 5 cm as well. What was measured
of the same file (by its content) is not measured again. `--tuning` takes the training fleet's vehicles that no network
learned from; the test days are for networks that no longer change.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import _quiet, read_results
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.ssl_days import ModelSet, Where, fleet_days, open_day, table1_days
from tests.benchmarks.studies.ssl_measures import ITERATIONS, STARTS, measure_day, measure_frames
from tests.benchmarks.studies.ssl_tables import abrupt_table, frames_table, rows_of, sigma_table
from tests.benchmarks.studies.table1 import ROWS, errors_table, row_of, verdicts_table

__all__ = ["Task", "heading", "run_tasks", "summary"]

_RESULTS = Path("tests/benchmarks/results")
_ENVIRONMENTS = ("", "urban", "highway")
PARTS = ("frames", "abrupt", "days", "polish")


@dataclass(frozen=True)
class Task:
    """One network (or three) on one day: what the lines of the result file stand for."""

    models: ModelSet
    where: Where
    part: str
    frames: int | None
    iterations: int = ITERATIONS  # passes per frame; single frames are measured after each of them

    @property
    def key(self) -> str:
        """What tells this measurement from all others; another network under the same name is another one."""
        what = [self.models.name, self.models.key, self.where.name, self.part, self.frames, self.iterations]
        return json.dumps(what)

    def measured(self) -> dict[str, Any]:
        """A line of the result file."""
        day = open_day(self.where)
        about = {
            "key": self.key,
            "method": self.models.row + (" + polish" if self.part == "polish" else ""),
            "part": self.part,
            "iterations": self.iterations,
            "day": {"name": self.where.name, "seed": self.where.seed, "environment": day.environment},
        }
        if self.part in {"days", "polish"}:
            polish = self.part == "polish"
            return about | measure_day(
                self.models, day, self.frames, iterations=self.iterations, polish=polish
            )
        starts = ["prior"] if self.part == "frames" else [s for s in STARTS if s != "prior"]
        return about | measure_frames(self.models, day, self.frames or len(day.rows), starts)


def run_tasks(tasks: Sequence[Task], out: Path, workers: int = 1) -> list[dict[str, Any]]:
    """Measure what is missing in `out`, a line each as it finishes; returns the lines of these tasks."""
    done = {r["key"] for r in read_results(out)}
    todo = [t for t in tasks if t.key not in done]
    about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}
    out.parent.mkdir(parents=True, exist_ok=True)
    print(f"{len(tasks)} measurements, {len(todo)} to do", flush=True)
    with (
        ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_quiet) as pool,
        out.open("a") as file,
    ):
        jobs = {pool.submit(task.measured): task for task in todo}
        for number, job in enumerate(as_completed(jobs), 1):
            task = jobs[job]
            said = f"{number}/{len(todo)} {task.models.row} {task.where.name} {task.part}"
            if job.exception() is not None:  # the others need not wait; it is missing until it is run again
                print(f"{said} FAILED {job.exception()!r}", flush=True)
                continue
            line = job.result() | about
            file.write(json.dumps(line) + "\n")
            file.flush()
            print(f"{said} ({line['cpu_s']} CPU s)", flush=True)
    wanted = {t.key for t in tasks}
    return [r for r in read_results(out) if r["key"] in wanted]


def heading(results: Sequence[dict[str, Any]], tasks: Sequence[Task], study: str) -> str:
    """Whether the days were seen before, what was measured, at which commits, of which files."""
    commits, dates = (", ".join(sorted({r[k] for r in results})) for k in ("commit", "date"))
    models = ", ".join(dict.fromkeys(f"{t.models.row} = {t.models.key}" for t in tasks))
    asked = f"{len(results)} of {len(tasks)}" if tasks else f"{len(results)}"
    measured = f"{asked} measurements; commit {commits}; {dates}; {models}".removesuffix("; ")
    return f"{look(study, results)}\n\n{measured}"


def summary(results: list[dict[str, Any]], others: list[dict[str, Any]]) -> str:
    """Tables of all parts; `others` are lines of table1.jsonl, measured on the same days."""
    days = [r for r in results if r["part"] in {"days", "polish"}]
    parts = []
    if days:
        rows = [*(row.name for row in ROWS if any(row_of(r) == row.name for r in others)), *rows_of(days)]
        parts += [errors_table([*others, *days], e, rows) for e in _ENVIRONMENTS if _any(days, e)]
        parts += [verdicts_table([*others, *days], rows), sigma_table(days)]
    if frames := [r for r in results if r["part"] == "frames"]:
        parts.append(frames_table(frames))
    if abrupt := [r for r in results if r["part"] == "abrupt"]:
        parts.append(abrupt_table(abrupt, [s for s in STARTS if s != "prior"]))
    return "\n\n".join(parts)


def _any(days: list[dict[str, Any]], environment: str) -> bool:
    return environment == "" or any(r["day"]["environment"] == environment for r in days)


def main() -> None:
    """Measure what is missing, then print the tables."""
    args = _arguments()
    places = (fleet_days(args.root) if args.tuning else table1_days(args.root))[: args.days]
    counts = {
        "frames": args.frames,
        "abrupt": args.frames,
        "days": args.day_frames,
        "polish": args.day_frames,
    }
    tasks = [
        Task(models, where, part, counts[part])
        for models in args.models
        for part in args.parts
        for where in places
    ]
    # Without models: tables of all that was measured before.
    results = run_tasks(tasks, args.out, args.workers) if tasks else read_results(args.out)
    if not results:
        return
    others = [] if args.tuning else read_results(_RESULTS / "table1.jsonl")
    text = f"{heading(results, tasks, args.out.stem)}\n\n{summary(results, others)}\n"
    args.out.with_suffix(".md").write_text(text)
    print(text)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="*", type=ModelSet.parse, default=[], metavar="NAME=FILE[,..]")
    parser.add_argument(
        "--root", type=Path, required=True, help="folder of ssl_fleet.py: table1, or fleet with --tuning"
    )
    parser.add_argument("--tuning", action="store_true", help="the training fleet's other vehicles")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=["frames", "abrupt", "days"])
    parser.add_argument("--days", type=int, default=None, help="at most so many vehicle-days")
    parser.add_argument("--frames", type=int, default=20, help="single frames per day")
    parser.add_argument("--day-frames", type=int, default=None, help="thin whole days to so many frames")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=_RESULTS / "ssl_table1.jsonl")
    return parser.parse_args()


if __name__ == "__main__":
    main()
