"""Study: camera-lidar of cameras without semantics, whose borders are steps of brightness.

    python -m tests.benchmarks.studies.without_semantics --root FOLDER [--days NAME ...] [--starts DEG ...]

Real logs and simulated days are read with a fleet.toml that names no semantics; all else is the product's. A start is
turned by exactly so many degrees (and 2.5 cm per degree), as it states; `hidden` ones state the default 2 deg / 5 cm
all the same. A simulated day is named `RIG:LANDSCAPE:SEED`, with `:night` or `:dusk` behind it. `z` is the error in
sigmas of the result and of the reference. A result is wrong where an error is beyond the limit of .2 deg.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.config import FleetConfig, load_fleet
from pipeline.extrinsics.estimates import Prior
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.geometry.targets import errors_at_targets
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.store.current import targets_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation
from tests.accuracy.days import SHARED
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.metrics import LIMITS_DEG, rms, transform_of
from tests.makers.stages import ingest_day, perceive_day

__all__ = ["LOGS", "day_of", "found_from", "summary"]

_PAIR: Final = "camera_lidar"
_M_PER_DEG: Final = 0.025
_DATE: Final = "2026-03-02"
_FRAMES: Final = 60
_CAMERA_AND_LIDAR: Final = """
[rigs.default.camera]
image = "/camera/front/image/compressed"
info = "/camera/front/camera_info"
[rigs.default.lidar]
points = "/lidar/top/points"
[rigs.default.prior]
source = "tf_static"
"""
_RADAR: Final = """
[rigs.default.radar]
points = "/radar/front/points"
doppler_field = "doppler"
"""
_ASTYX: Final = 'doppler_positive = "approaching"\ndoppler_period_mps = 10.394\n'
_OTHER: Final = 'doppler_positive = "receding"\n[rigs.default.ego]\nodometry = "/vehicle/odometry"\n'
# By log: files, vehicle-day, fleet.toml beyond camera and lidar, and how well the reference is known [deg].
LOGS: Final = {
    "other_world": ("other_world/*.mcap", Partition("veh00", "2026-03-02"), _RADAR + _OTHER, 0.0),
    "real_car": ("astyx/astyx-1_*", Partition("astyx-1", "2019-01-14"), _RADAR + _ASTYX, 0.2),
    "kitti": ("kitti/*.mcap", Partition("kitti-1", "2011-09-26"), "", 0.1),
}


def main() -> None:
    """Append a line per start and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="lakes are made here, or used if there")
    parser.add_argument("--days", nargs="+", default=list(LOGS))
    parser.add_argument("--starts", type=float, nargs="+", default=[2.0])
    parser.add_argument("--hidden", action="store_true", help="starts state the default sigmas")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--out", type=Path, default=RESULTS / "without_semantics.jsonl")
    args = parser.parse_args()
    about, lines = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}, []
    for name in args.days:
        rows, fleet, true = day_of(name, args.root)
        for deg in args.starts:
            for seed in args.seeds:
                line = {"day": name, "start_deg": deg, "hidden": args.hidden, "seed": seed}
                record, cpu_s = found_from(rows, fleet, true, deg, seed, is_hidden=args.hidden)
                found = {"cpu_s": round(cpu_s, 1)} | _errors(record, true, _known_deg(name))
                lines.append(about | line | found)
                with args.out.open("a") as out:
                    out.write(json.dumps(lines[-1]) + "\n")
                print(json.dumps(lines[-1]), flush=True)
    print(summary(lines))


def day_of(name: str, root: Path) -> tuple[list[Observation], FleetConfig, Prior]:
    """Observations of a day without its labels, and its truth; of real cars the logged calibration."""
    folder = root / name.replace(":", "_")
    folder.mkdir(parents=True, exist_ok=True)
    logs, day, toml, truth = _logged(name, folder) if name in LOGS else _simulated(name, folder)
    lake, fleet = Lake.at(folder / "lake"), _without_semantics(load_fleet(toml))
    if day not in lake.partitions("perceived"):
        ingest_day(logs, day, fleet, lake)
        perceive_day(day, fleet, lake)
    rows = list(observations_of(lake, day))
    given = read_prior(rows, fleet, day.vehicle)
    if truth.exists():
        known = {k: np.array(T) for k, T in json.loads(truth.read_text()).items() if k.startswith("T_")}
        given = replace(given, T_camera_lidar=known["T_camera_lidar"], T_lidar_radar=known["T_lidar_radar"])
    return rows, fleet, given


def _logged(name: str, folder: Path) -> tuple[list[Path], Partition, Path, Path]:
    files, day, extra, _ = LOGS[name]
    vehicle = f'[fleet]\nname = "without-semantics"\n[vehicles."{day.vehicle}"]\nrig = "default"\n'
    (folder / "fleet.toml").write_text(vehicle + _CAMERA_AND_LIDAR + extra)
    return sorted(SHARED.glob(files)), day, folder / "fleet.toml", (SHARED / files).parent / "truth.json"


def _simulated(name: str, folder: Path) -> tuple[list[Path], Partition, Path, Path]:
    rig, landscape, seed, *light = name.split(":")
    faults = ",".join(f"vehicle-1:{_DATE}:camera:{fault}:1" for fault in light)
    if not (folder / "fleet.toml").exists():
        spec = FleetSpec(
            1, 1, _DATE, _FRAMES, rig=rig, environments=landscape, seed=int(seed), faults=parse_faults(faults, [_DATE])
        )  # fmt: skip
        simulate_fleet(spec, folder)
    day = Partition("vehicle-1", _DATE)
    logs = sorted((folder / "logs" / day.vehicle / day.day).iterdir())
    return logs, day, folder / "fleet.toml", folder / "truth" / day.vehicle / f"{day.day}.json"


def _without_semantics(fleet: FleetConfig) -> FleetConfig:
    """As if fleet.toml named none: it decides what is read, so labels of the logs are not."""
    rigs = {}
    for name, rig in fleet.rigs.items():
        cameras = {n: camera.model_copy(update={"semantics": None}) for n, camera in rig.cameras.items()}
        rigs[name] = rig.model_copy(update={"cameras": cameras})
    return fleet.model_copy(update={"rigs": rigs})


def found_from(
    rows: Sequence[Observation],
    fleet: FleetConfig,
    true: Prior,
    deg: float,
    seed: int,
    *,
    is_hidden: bool = False,
) -> tuple[CalibrationRecord, float]:
    """The record of camera-lidar from a start turned by `deg`, and its CPU seconds."""
    began, start = time.process_time(), perturbed(true, (deg, _M_PER_DEG * deg), seed)
    if is_hidden:
        sigmas = {k: getattr(true, k) for k in ("rotation_sigma_rad", "translation_sigma_m")}
        start = replace(start, **sigmas)
    inputs = Inputs(Partition("any", _DATE), "joint", "study", seed, (), pairs=(_PAIR,))
    [record] = calibrate_observations(rows, start, fleet, inputs)
    return record, time.process_time() - began


def _known_deg(name: str) -> float:
    return LOGS[name][3] if name in LOGS else 0.0


def _errors(record: CalibrationRecord, true: Prior, known_deg: float) -> dict[str, Any]:
    told = {"status": record.status, "reason": record.reason, "frames_used": record.frames_used}
    T = transform_of(record)
    if T is None or record.azimuth_sigma_rad is None or record.elevation_sigma_rad is None:
        return told
    off = np.degrees(errors_at_targets(_PAIR, T, true.of(_PAIR), targets_of(record))[:2])
    sigma = np.degrees([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    names = ("az_deg", "el_deg", "az_sigma_deg", "el_sigma_deg", "az_z", "el_z")
    values = [*off, *sigma, *(off / np.hypot(sigma, known_deg))]
    return told | {name: round(float(v), 3) for name, v in zip(names, values, strict=True)}


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """A row per day and start."""
    heads = ["day", "start [deg]", "azimuth: mean, worst [deg]", "elevation", "mean sigmas", "RMS z"]
    heads += ["accepted", "wrong", "CPU s"]
    rows = [heads, ["---"] * len(heads)]
    for day, deg, hidden in dict.fromkeys((r["day"], r["start_deg"], r["hidden"]) for r in lines):
        mine = [r for r in lines if (r["day"], r["start_deg"], r["hidden"]) == (day, deg, hidden)]
        known = [r for r in mine if "el_z" in r]
        off = [
            f"{np.mean([r[k] for r in known]):.2f}, {max(r[k] for r in known):.2f}" if known else "-"
            for k in ("az_deg", "el_deg")
        ]
        sigma = "/".join(f"{np.mean([r[k] for r in known]):.2f}" for k in ("az_sigma_deg", "el_sigma_deg"))
        z = f"{rms([r[k] for r in known for k in ('az_z', 'el_z')]):.1f}"
        accepted = [r for r in mine if r["status"] == "accepted"]
        wrong = sum(max(r["az_deg"], r["el_deg"]) > LIMITS_DEG[_PAIR] for r in accepted)
        cpu = f"{np.mean([r['cpu_s'] for r in mine]):.0f}"
        start = f"{deg:g}{' hidden' if hidden else ''}"
        rows.append([day, start, *off, sigma, z, f"{len(accepted)}/{len(mine)}", f"{wrong}", cpu])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


if __name__ == "__main__":
    main()
