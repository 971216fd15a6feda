"""Pages like the paper's figure 4: sensors knocked by 2, 5 and 10 deg, put right from one frame.

    python -m tests.benchmarks.studies.ssl_pages --root SSL/table1 --model joint.onnx --out PAGES

The frames are those at a quarter, half and three quarters of the first urban day of Table 1 (`--day` names another),
so nobody chose them by their looks. Each page comes from `boresight calibrate --frame N --perturb DEG,.05 --page FILE`;
the transforms go to PAGES/abrupt.json, with the paper's errors at its targets against the truth, before and after.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.targets import errors_at_targets
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.ssl_days import SslDay, open_day, simulated_days

__all__ = ["fleet_file_with", "write_page"]

KNOCKS_DEG = (2.0, 5.0, 10.0)
_KNOCK_M = 0.05


def fleet_file_with(model: Path, given: Path, folder: Path) -> Path:
    """A copy of fleet.toml that names the network."""
    folder.mkdir(parents=True, exist_ok=True)
    out = folder / "fleet.toml"
    out.write_text(f"{given.read_text()}\n[learn]\nmodel = {json.dumps(str(model.resolve()))}\n")
    return out


def write_page(day: SslDay, fleet: Path, row: int, knock_deg: float, page: Path) -> dict[str, Any]:
    """One page by the command line; returns errors before and after."""
    frame = day.rows[row].frame_index
    command = [
        *(sys.executable, "-m", "jobs.cli", "calibrate", "--fleet", str(fleet)),
        *("--lake", str(day.where.folder / "lake"), "--vehicle", day.where.vehicle, "--day", day.where.day),
        *("--frame", str(frame), "--perturb", f"{knock_deg:g},{_KNOCK_M}", "--seed", str(day.where.seed)),
        *("--page", str(page)),
    ]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    errors = {
        pair: {
            when: _errors(pair, np.array(found["estimates"][pair][key]), day.true_of(pair))
            for when, key in (("before", "T_prior"), ("after", "T"))
        }
        for pair in PAIRS
    }
    return {
        "day": day.where.name,
        "frame_index": frame,
        "knock_deg": knock_deg,
        "page": page.name,
        "errors": errors,
    }


def _errors(pair: str, T: np.ndarray, T_true: np.ndarray) -> list[float]:
    azimuth, elevation, range_m = errors_at_targets(pair, T, T_true)
    return [round(float(v), 3) for v in (np.degrees(azimuth), np.degrees(elevation), range_m)]


def main() -> None:
    """Write the pages and print their errors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of ssl_fleet.py: table1")
    parser.add_argument("--model", type=Path, required=True, help="joint network")
    parser.add_argument("--day", default=SETS["table1"][0].name)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    spec = next(s for s in SETS["table1"] if s.name == args.day)
    day = open_day(simulated_days(args.root, [spec])[0])
    fleet = fleet_file_with(args.model, day.fleet_file, args.out)
    told = []
    for k, knock_deg in enumerate(KNOCKS_DEG, 1):
        page = args.out / f"abrupt_{knock_deg:g}_deg.html"
        told.append(write_page(day, fleet, k * len(day.rows) // 4, knock_deg, page))
        for pair, errors in told[-1]["errors"].items():
            print(
                f"{page.name} frame {told[-1]['frame_index']} {pair}: {errors['before']} -> {errors['after']}"
            )
    (args.out / "abrupt.json").write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
