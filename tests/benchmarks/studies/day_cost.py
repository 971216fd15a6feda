"""CPU from observations to verdict: a day's calibration by `joint`, compiled code warm, in one thread.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tests/benchmarks/studies/day_cost.py --root DAYS [--profile 40]

The days are those of set `day-cost` (seeds that are burnt, 100 frames): for time they are as good as any. CPU
time counts this process alone, but caches and a core's second thread are shared: on a busy machine it is up to a half
more, so each day is calibrated several times and the least is stated.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import time
from pathlib import Path

from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.days import SETS, load_day
from tests.benchmarks.studies.engine import RESULTS, Run, calibrate_once

__all__ = ["main"]

_FEW_FRAMES = 12  # of the calibration that compiles, or loads what was compiled


def main() -> None:
    """Calibrate each day `--times` times and write the least CPU time, or print where it goes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="days that days.py generated")
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--profile", type=int, default=0, help="print so many functions, by cumulated time")
    parser.add_argument("--out", type=Path, default=RESULTS / "day_cost.json")
    args = parser.parse_args()
    lines = {}
    for spec in SETS["day-cost"]:
        day, run = load_day(spec, args.root), Run(spec, seed=spec.seed)
        calibrate_once(Run(spec, seed=spec.seed, select={"frames": _FEW_FRAMES}), day)
        if args.profile:
            profiler = cProfile.Profile()
            profiler.runcall(calibrate_once, run, day)
            pstats.Stats(profiler).sort_stats("cumtime").print_stats(args.profile)
            continue
        spent = []
        for _ in range(args.times):
            began = time.process_time()
            result = calibrate_once(run, day)
            spent.append(round(time.process_time() - began, 2))
        lines[spec.name] = {
            "cpu_s": min(spent),
            "all_cpu_s": spent,
            "status": {pair: p["status"] for pair, p in result["pairs"].items()},
        }
        print(spec.name, lines[spec.name], flush=True)
    if lines:
        about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}
        args.out.write_text(json.dumps(about | {"days": lines}, indent=1) + "\n")


if __name__ == "__main__":
    main()
