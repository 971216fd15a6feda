"""Study: which part of training and inference carries what, on the training fleet's vehicles that nobody learned from.

    python -m tests.benchmarks.studies.ssl_ablation --root SSL/fleet --exports ONNX \
        --runs matching=RUN no-loop=RUN one-sided=RUN concat=RUN

Runs are folders of `boresight train`, which differ by their train.toml and nothing else; the first is what the others
are compared with. Every run is measured frame by frame after one, two and three passes, and as whole days, thinned; the
first also as whole days of one and two passes. Test days stay unseen.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.metrics import share
from tests.benchmarks.studies.ssl_days import ModelSet, fleet_days
from tests.benchmarks.studies.ssl_measures import ITERATIONS
from tests.benchmarks.studies.ssl_table1 import Task, heading, run_tasks
from tests.benchmarks.studies.ssl_tables import frame_values, rows_of

__all__ = ["exported", "summary"]

_DAY_FRAMES = 30


def exported(name: str, run: Path, folder: Path) -> ModelSet:
    """The run's best network as a file, made once per checkpoint."""
    digest = hashlib.sha256((run / "best.pt").read_bytes()).hexdigest()[:10]
    path = folder / f"{name}_{digest}.onnx"
    if not path.exists():
        from pipeline.learn.export.onnx_file import export_onnx
        from pipeline.learn.train.run_state import network_of_run

        folder.mkdir(parents=True, exist_ok=True)
        export_onnx(network_of_run(run), path)
    return ModelSet(name, (path.resolve(),))


def summary(results: list[dict[str, Any]]) -> str:
    """One table: single frames by pass, a knock of 5 deg, whole days."""
    lines = [
        "az / el [deg] (/ range [m] for lidar-radar): single frames mean over frames, abrupt 5 deg median, days mean:",
        "",
        "| run | passes | what | n | camera-lidar | camera-radar | lidar-radar | days accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in rows_of(results):
        mine = [r for r in results if r["method"] == method]
        for start, middle in (("prior", np.mean), ("abrupt 5", np.median)):
            for passes in range(1, ITERATIONS + 1) if start == "prior" else [ITERATIONS]:
                found = {p: frame_values(mine, method, start, p, "errors") for p in PAIRS}
                if not all(len(v) for v in found.values()):
                    continue
                cells = [_cell(p, middle(v[:, passes - 1], axis=0)) for p, v in found.items()]
                lines.append(
                    f"| {method} | {passes} | frame, {start} | {len(found[PAIRS[0]])} | {' | '.join(cells)} | |"
                )
        for passes in range(1, ITERATIONS + 1):
            days = [
                r["pairs"]
                for r in mine
                if r["part"] == "days" and r["iterations"] == passes and len(r["pairs"]) == len(PAIRS)
            ]
            if days:
                cells = [_cell(p, np.mean([_errors(d[p]) for d in days], axis=0)) for p in PAIRS]
                accepted = share(d[p]["status"] == "accepted" for d in days for p in PAIRS)
                lines.append(
                    f"| {method} | {passes} | day | {len(days)} | {' | '.join(cells)} | {accepted} |"
                )
    return "\n".join(lines)


def _errors(measured: dict[str, Any]) -> list[float]:
    """A refused pair keeps its prior, as its user does."""
    before = "" if "az_deg" in measured else "prior_"
    return [measured[f"{before}{q}"] for q in ("az_deg", "el_deg", "range_m")]


def _cell(pair: str, values: np.ndarray) -> str:
    angles = f"{values[0]:.2f} / {values[1]:.2f}"
    return f"{angles} / {values[2]:.3f}" if pair == "lidar_radar" else angles


def main() -> None:
    """Export, measure what is missing, print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="fleet of ssl_fleet.py")
    parser.add_argument("--runs", nargs="+", required=True, metavar="NAME=RUN")
    parser.add_argument("--exports", type=Path, required=True, help="where ONNX files go")
    parser.add_argument("--days", type=int, default=None, help="at most so many vehicle-days")
    parser.add_argument("--frames", type=int, default=20, help="single frames per day")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/ssl_ablation.jsonl"))
    args = parser.parse_args()
    runs = dict(text.split("=", 1) for text in args.runs)
    models = [exported(name, Path(run), args.exports) for name, run in runs.items()]
    places = fleet_days(args.root)[: args.days]
    tasks = [
        Task(m, where, part, _DAY_FRAMES if part == "days" else args.frames)
        for m in models
        for part in ("frames", "abrupt", "days")
        for where in places
    ]
    tasks += [
        replace(t, iterations=n)
        for t in tasks
        for n in range(1, ITERATIONS)
        if t.part == "days" and t.models == models[0]
    ]
    results = run_tasks(tasks, args.out, args.workers)
    if results:
        text = f"{heading(results, tasks, args.out.stem)}\n\n{summary(results)}\n"
        args.out.with_suffix(".md").write_text(text)
        print(text)


if __name__ == "__main__":
    main()
