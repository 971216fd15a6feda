"""Study: camera-lidar of one street of KITTI, from 2 and 5 deg, of 26 and 5 frames: how far off, and does it say so?

    python tests/benchmarks/studies/kitti.py --lake FOLDER

FOLDER has the fleet.toml of `boresight convert kitti` and a lake that was perceived. Starts are 2 deg / 5 cm and
5 deg / 10 cm off as they state, four seeds each. `z` is the error against KITTI's calibration in sigmas of both.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.core.config import FleetConfig, load_fleet
from pipeline.rig.day_prior import perturbed, read_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import targets_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.metrics import rms, share, transform_of

__all__ = ["GIVEN_SIGMA_DEG", "line_of", "summary"]

GIVEN_SIGMA_DEG: Final = 0.1  # how well the given calibration is known
_STARTS: Final = ((2.0, 0.05), (5.0, 0.1))
_FRAMES: Final = (26, 5)
_PAIR: Final = "camera_lidar"


def main() -> None:
    """Write a line per start and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lake", type=Path, required=True, help="folder with fleet.toml and lake")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(4)))
    parser.add_argument("--out", type=Path, default=RESULTS / "kitti.jsonl")
    args = parser.parse_args()
    lake, fleet = Lake.at(args.lake / "lake"), load_fleet(args.lake / "fleet.toml")
    [day] = lake.partitions("perceived")
    rows = list(observations_of(lake, day))
    given, lines = read_prior(rows, fleet, day.vehicle), []
    about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}
    for frames in _FRAMES:
        for start in _STARTS:
            for seed in args.seeds:
                record, cost = _calibrated(rows, perturbed(given, start, seed), fleet, day, (frames, seed))
                line = {"start_deg": start[0], "frames": frames, "seed": seed} | cost
                lines.append(about | line | line_of(record, given))
                print(json.dumps(lines[-1]), flush=True)
    args.out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    print(summary(lines))


def _calibrated(
    rows: Sequence[Observation], prior: Prior, fleet: FleetConfig, day: Partition, of: tuple[int, int]
) -> tuple[CalibrationRecord, dict[str, float]]:
    """The record of so many frames with a seed, and its CPU time [s]."""
    began = time.process_time()
    inputs = Inputs(day, "joint", "study", of[1], (), pairs=(_PAIR,))
    [record] = calibrate_observations(rows, prior, fleet.changed(select={"frames": of[0]}), inputs)
    return record, {"cpu_s": round(time.process_time() - began, 1)}


def line_of(record: CalibrationRecord, given: Prior) -> dict[str, Any]:
    """What a record says beside the given calibration; without numbers where nothing was computed."""
    told = {"status": record.status, "reason": record.reason, "frames_used": record.frames_used}
    T = transform_of(record)
    if T is None or record.azimuth_sigma_rad is None or record.elevation_sigma_rad is None:
        return told
    off = np.degrees(errors_at_targets(_PAIR, T, given.of(_PAIR), targets_of(record))[:2])
    sigma = np.degrees([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    names = ("az_deg", "el_deg", "az_sigma_deg", "el_sigma_deg", "az_z", "el_z")
    values = [*off, *sigma, *(off / np.hypot(sigma, GIVEN_SIGMA_DEG))]
    return told | {name: round(float(v), 3) for name, v in zip(names, values, strict=True)}


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """A row per start and number of frames."""
    head = "| start | frames | azimuth, mean, worst [deg] | elevation | RMS z | within 3 | accepted |"
    text = [head, "|---" * 7 + "|"]
    for start, frames in dict.fromkeys((r["start_deg"], r["frames"]) for r in lines):
        mine = [r for r in lines if (r["start_deg"], r["frames"]) == (start, frames)]
        known = [r for r in mine if "el_z" in r]
        off = (
            f"{np.mean([r[k] for r in known]):.2f}, {max(r[k] for r in known):.2f}"
            for k in ("az_deg", "el_deg")
        )
        z = [r[k] for r in known for k in ("az_z", "el_z")]
        shares = (share(v <= 3 for v in z), share(r["status"] == "accepted" for r in mine))
        cells = [*(off if known else ("-", "-")), f"{rms(z):.2f}", *shares]
        text.append(f"| {start:g} deg | {frames} | {' | '.join(cells)} |")
    return "\n".join(text)


if __name__ == "__main__":
    main()
