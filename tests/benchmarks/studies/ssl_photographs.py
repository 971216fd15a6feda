"""Study: networks on the logs of a real car, whose photographs no simulated car could teach them.

    python -m tests.benchmarks.studies.ssl_photographs --real FOLDER --models shipped=joint.onnx [--modes both image]

FOLDER has fleet.toml and a lake with one real vehicle-day, ingested and perceived. Whole days as the product records
them, started 2 deg / 0.2 m off by several draws, and single frames of each log, knocked by 5 deg / 5 cm: with
the logged classes and the image, with either alone; `--polish`: days whose answers are optimised directly from there,
as `[solve] polish` does. Distances are to the logs' own calibration, itself good to about
0.2 deg: nothing finer is a claim about the car. What was measured already is kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import load_fleet
from pipeline.extrinsics.prior import read_prior
from pipeline.store.partitions import Lake
from pipeline.store.views import observations_of, perceived_days
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay, Where
from tests.benchmarks.studies.ssl_measures import measure_day, measure_frames

__all__ = ["by_log", "days_told", "frames_told", "real_day", "summary"]

_START = "abrupt 5"
_MODES = ("both", "classes", "image")


def real_day(folder: Path) -> SslDay:
    """The only vehicle-day of a folder; its logged calibration stands in for the truth that nobody knows."""
    lake, fleet = Lake.at(folder / "lake"), load_fleet(folder / "fleet.toml")
    [partition] = perceived_days(lake)
    rows = list(observations_of(lake, partition))
    given = read_prior(rows, fleet, partition.vehicle)
    truth: dict[str, object] = {f"T_{pair}": given.of(pair).tolist() for pair in PAIRS}
    return SslDay(Where(folder, partition.vehicle, partition.day, 0), rows, truth, fleet)


def by_log(day: SslDay) -> dict[str, SslDay]:
    """The day's logs, each as a day of its own."""
    names = sorted({o.log for o in day.rows})
    return {name: replace(day, rows=[o for o in day.rows if o.log == name]) for name in names}


def days_told(models: ModelSet, day: SslDay, draws: int, *, polish: bool = False) -> list[dict[str, Any]]:
    """The product's records of the day, a draw of the start each."""
    drawn = [replace(day, where=replace(day.where, seed=k)) for k in range(draws)]
    found = [measure_day(models, one, polish=polish) for one in drawn]
    keep = ("az_deg", "el_deg", "range_m", "prior_az_deg", "prior_el_deg", "status", "reason")
    return [{p: {k: told.get(k) for k in keep} for p, told in one["pairs"].items()} for one in found]


def frames_told(models: ModelSet, day: SslDay, frames: int) -> dict[str, dict[str, list[float]]]:
    """By pair, mean and median az [deg], el [deg], range [m] of single frames after three passes."""
    found = measure_frames(models, day, frames, [_START])["starts"][_START]
    errors = {pair: np.array(told["errors"])[:, -1] for pair, told in found.items()}
    return {
        pair: {"mean": e.mean(0).round(3).tolist(), "median": np.median(e, axis=0).round(3).tolist()}
        for pair, e in errors.items()
    }


def summary(results: Mapping[str, Any]) -> str:
    """Two tables of Markdown: days, and single frames by log."""
    rule = "---|" * len(PAIRS)
    days = ["Days of all logs, started 2 deg / 0.2 m off, mean over draws of az / el [deg] / range [m]:", ""]
    days += [f"| network, shown | draws | {' | '.join(PAIRS)} | accepted |", f"|---|---|{rule}---|"]
    frames = ["Single frames, knocked by 5 deg / 5 cm, three passes: median (mean) az / el [deg]:", ""]
    frames += [f"| network, shown | log | {' | '.join(PAIRS)} |", f"|---|---|{rule}"]
    for name, told in results.items():
        if told.get("days"):
            cells = [_day_cell([one[pair] for one in told["days"]]) for pair in PAIRS]
            accepted = sum(r["status"] == "accepted" for one in told["days"] for r in one.values())
            number = sum(len(one) for one in told["days"])
            days.append(f"| {name} | {len(told['days'])} | {' | '.join(cells)} | {accepted} of {number} |")
        for log, found in told.get("frames", {}).items():
            cells = [
                "{:.2f} / {:.2f} ({:.2f} / {:.2f})".format(
                    *found[pair]["median"][:2], *found[pair]["mean"][:2]
                )
                for pair in PAIRS
            ]
            frames.append(f"| {name} | {log} | {' | '.join(cells)} |")
    return "\n".join(days) + "\n\n" + "\n".join(frames)


def _day_cell(records: list[dict[str, Any]]) -> str:
    values = np.array([[r[k] for k in ("az_deg", "el_deg", "range_m")] for r in records], np.float64)
    return "{:.2f} / {:.2f} / {:.2f}".format(*values.mean(axis=0))


def main() -> None:
    """Measure what is missing, write, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--real", type=Path, required=True, help="folder with fleet.toml and lake")
    parser.add_argument("--models", nargs="+", type=ModelSet.parse, required=True, metavar="NAME=FILE")
    parser.add_argument("--modes", nargs="+", choices=_MODES, default=list(_MODES))
    parser.add_argument("--parts", nargs="+", choices=["days", "frames"], default=["days", "frames"])
    parser.add_argument("--logs", nargs="+", help="only these; for networks that the others taught")
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--polish", action="store_true", help="days alone")
    parser.add_argument("--frames", type=int, default=24, help="single frames of each log")
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/ssl_photographs.json"))
    args = parser.parse_args()
    results: dict[str, Any] = json.loads(args.out.read_text()) if args.out.exists() else {}
    for models in args.models:
        for mode in args.modes:
            day = real_day(args.real)
            day = replace(day, fleet=day.fleet.changed(learn={"camera": mode}))
            logs = {log: part for log, part in by_log(day).items() if not args.logs or log in args.logs}
            seen = {o.frame_index for part in logs.values() for o in part.rows}
            day = replace(day, rows=[o for o in day.rows if o.frame_index in seen])
            name = f"{models.name}, {mode}" + (", polished" if args.polish else "")
            told = results.setdefault(name, {"network": models.key})
            told |= {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}
            if "days" in args.parts and not told.get("days"):
                told["days"] = days_told(models, day, args.draws, polish=args.polish)
            if "frames" in args.parts and not args.polish and not told.get("frames"):
                told["frames"] = {log: frames_told(models, part, args.frames) for log, part in logs.items()}
            args.out.write_text(json.dumps(results, indent=1) + "\n")
            print(summary(results), flush=True)
    args.out.with_suffix(".md").write_text(summary(results) + "\n")


if __name__ == "__main__":
    main()
