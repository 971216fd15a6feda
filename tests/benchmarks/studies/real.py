"""Study: real days, calibrated from priors that are exactly so far off, against the calibration given.

    python -m tests.benchmarks.studies.real --root DAYS [--shared FOLDER] [--starts 5] [--out RESULTS.jsonl]

FOLDER/data/astyx holds a car's four logs and given_calibration.json, which is good to .2 deg; FOLDER/data/kitti a
street of KITTI, whose calibration is good to .1 deg; FOLDER/models what labels its images. Method `joint` starts 2, 5
and 10 deg off, the included network 2 deg. Everybody who worked on this looked at these days.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from itertools import product
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
from tests.makers.kitti_street import converted_street, given_of

FLEET = Path("tests/end_to_end/astyx.toml")
SHARED = Path("../shared")
DAY, STREET = Partition("astyx-1", "2019-01-14"), Partition("kitti-1", "2011-09-26")
SHIFT_M = 0.05
# fleet.toml, the lake with the day perceived, the day, its given transforms by pair
Real = tuple[Path, Lake, Partition, Mapping[str, np.ndarray]]
STARTS = (("joint", 2.0), ("joint", 5.0), ("joint", 10.0), ("joint-ssl", 2.0))


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the day's lake")
    parser.add_argument("--shared", type=Path, default=SHARED, help="folder of the data and models")
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "real.jsonl")
    args = parser.parse_args()
    known = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    lines = [r for r in known if is_accepted(r["commit"], commit_now(), ())]
    for name, source, starts in (("", _car, STARTS), ("KITTI: ", _street, STARTS[:3])):
        if not args.shared.is_dir():
            sys.stderr.write(f"{name}real days are left out: no folder {args.shared}\n")
            continue
        path, lake, day, truth = source(args.shared.resolve(), args.root)
        for (method, deg), seed in product(starts, range(args.starts)):
            row = f"{name}{method}, {deg:g} deg"
            if not any((r["row"], r["seed"]) == (row, seed) for r in lines):
                fleet = load_fleet(path).changed(solve={"search_rotation_deg": max(6.0, 1.2 * deg)})
                found = {"pairs": calibrated(fleet, lake, day, method, (deg, SHIFT_M), seed, truth)}
                lines.append({"row": row, "seed": seed, "commit": commit_now()} | found)
                with args.out.open("a") as file:
                    file.write(json.dumps(lines[-1]) + "\n")
    sys.stdout.write(by_row(lines) + "\n")


def _car(shared: Path, root: Path) -> Real:
    logs = shared / "data" / "astyx"
    named = sorted(p for p in logs.iterdir() if p.name.startswith(DAY.vehicle))
    truth = read_transforms(logs / "given_calibration.json")
    return FLEET, perceived_lake(root / "real-car", FLEET, DAY, named), DAY, truth


def _street(shared: Path, root: Path) -> Real:
    folder, (log,) = root / "kitti", sorted((shared / "data" / "kitti").glob("*.mcap"))
    T = given_of(log)
    if not (folder / "fleet.toml").exists():
        shutil.rmtree(folder, ignore_errors=True)
        models = shared / "models"
        converted_street(log, folder, STREET, (models / "espnetv2_city.onnx", models / "yolox_nano.onnx"))
    logs = sorted((folder / "logs" / STREET.vehicle / STREET.day).iterdir())
    lake = perceived_lake(folder / "lake", folder / "fleet.toml", STREET, logs)
    return folder / "fleet.toml", lake, STREET, {"camera_lidar": T}


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
