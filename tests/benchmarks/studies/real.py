"""Study: a real car's four logs, calibrated from priors that are exactly so far off, against the calibration given.

    python -m tests.benchmarks.studies.real --root DAYS [--logs FOLDER] [--starts 5] [--out RESULTS.jsonl]

FOLDER holds the car's logs and given_calibration.json, which is good to .2 deg. Method `joint` starts 2, 5 and 10 deg
off, the included network 2 deg. Their day was looked at by everybody who worked on this.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.config import FleetConfig, load_fleet
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE, INGEST, PERCEIVE
from pipeline.rig.day_prior import read_transforms
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import targets_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import perceived
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.benchmarks.studies.commits import commit_now, is_accepted
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.run import by_row

FLEET = Path("tests/end_to_end/astyx.toml")
LOGS = Path("../shared/data/astyx")
DAY = Partition("astyx-1", "2019-01-14")
SHIFT_M = 0.05
STARTS = (("joint", 2.0), ("joint", 5.0), ("joint", 10.0), ("joint-ssl", 2.0))


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the day's lake")
    parser.add_argument("--logs", type=Path, default=LOGS, help="folder of the car's logs")
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "real.jsonl")
    args = parser.parse_args()
    if not args.logs.is_dir():
        sys.stderr.write(f"the real car is left out: no folder {args.logs}\n")
        return
    known = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    lines = [r for r in known if is_accepted(r["commit"], commit_now(), ())]
    named = sorted(p for p in args.logs.iterdir() if p.name.startswith(DAY.vehicle))
    lake = perceived_lake(args.root / "real-car", FLEET, DAY, named)
    truth = read_transforms(args.logs / "given_calibration.json")
    for method, deg in STARTS:
        for seed in range(args.starts):
            row = f"{method}, {deg:g} deg"
            if not any((r["row"], r["seed"]) == (row, seed) for r in lines):
                search = {"search_rotation_deg": max(6.0, 1.2 * deg)}
                fleet = load_fleet(FLEET).changed(solve=search)
                found = {"pairs": calibrated(fleet, lake, DAY, method, (deg, SHIFT_M), seed, truth)}
                lines.append({"row": row, "seed": seed, "commit": commit_now()} | found)
                with args.out.open("a") as file:
                    file.write(json.dumps(lines[-1]) + "\n")
    sys.stdout.write(by_row(lines) + "\n")


def perceived_lake(folder: Path, fleet: Path, day: Partition, logs: Sequence[Path]) -> Lake:
    """The lake of the folder, with the day of these logs ingested and perceived by this code once."""
    lake = Lake.at(folder)
    if perceived(lake, day) is None:
        for stage in (INGEST, PERCEIVE):
            stage.run(Task(load_fleet(fleet), lake, day, logs=tuple(logs)))
    return lake


def calibrated(
    fleet: FleetConfig, lake: Lake, day: Partition, method: str, off: tuple[float, float], seed: int,
    truth: Mapping[str, np.ndarray],
) -> dict[str, Any]:  # fmt: skip
    """Status and errors of each pair, from a prior that is exactly so much [deg, m] off."""
    CALIBRATE.run(Task(fleet, lake, day, method, perturb=off, seed=seed))
    every = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=day.vehicle)
    own = {
        r.pair: r for r in every if (r.method, r.seed, r.day) == (method, seed, day.day)
    }  # the last of each pair
    return {pair: _measured(own[pair], truth[pair]) for pair in PAIRS if pair in own}


def _measured(record: CalibrationRecord, T_true: np.ndarray) -> dict[str, Any]:
    T = transform_of(record)
    if T is None:
        return {"status": record.status, "reason": record.reason}
    azimuth, elevation, range_m = errors_at_targets(record.pair, T, T_true, targets_of(record))
    certified = {f"vouched_{n[:2]}": float(n in record.determined) for n in ("azimuth", "elevation")}
    return {
        "status": record.status, "az_deg": float(np.degrees(azimuth)), "el_deg": float(np.degrees(elevation)),
        "range_m": float(range_m), "observable": [int(v) for v in record.observable or []],
        "diagnostics": certified,
    }  # fmt: skip


if __name__ == "__main__":
    main()
