"""Study: night after night of fleets, by the commands of a night: are records, poses and states right, is drift found?

    python -m tests.benchmarks.studies.nights --root DAYS [--fleets demo van surveyed no_lidar] [--out RESULTS.jsonl]

Each fleet of FLEETS is simulated day by day; `boresight nightly` runs after each day. Of every vehicle and night there
is a line: its records and poses of that day, and the state that it would load, against the truth of that day, and the
sensors that audit calls RED. A state is farther from the truth than the prior where its turn is by more than .1 deg.
Nights that are in the file of results are not run again.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jobs.nightly import nightly
from pipeline.core.config import VerifyConfig
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, rotation_angle_rad
from pipeline.rig.targets import DEFAULT_TARGETS, errors_at_targets
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, begin_fleet, day_names, simulate_vehicle_day
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.store.current import current_poses, current_records, current_states, prior_of, transform_of
from pipeline.store.delta import merge_rows, with_months
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_records
from pipeline.store.rows import to_table
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.captures import CAPTURES
from schemas.drift import DRIFT, DriftFinding
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.poses import POSES, PoseRow
from schemas.states import STATES, StateRow
from tests.benchmarks.results_measures import named_red, nights_wrong, states_after
from tests.benchmarks.studies.commits import commit_now, is_accepted
from tests.benchmarks.studies.engine import RESULTS, boresight
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.run import table as markdown

__all__ = ["FLEETS", "run_fleets"]

FIRST_DAY = "2026-03-02"
_FARTHER_RAD = np.radians(0.1)  # less is what mounts move by from day to day
_LIMITS = VerifyConfig()


@dataclass(frozen=True)
class Fleet:
    """A fleet that drives some days; `moved` is in the simulator's words, on days from 0."""

    rig: str
    seed: int
    vehicles: int
    nights: int
    frames: int
    moved: str = ""
    is_aged: bool = False

    @property
    def spec(self) -> FleetSpec:
        """For the simulator."""
        rig, days = rig_named(self.rig), day_names(FIRST_DAY, self.nights)
        faults = parse_faults(self.moved, days, rig)
        return FleetSpec(
            vehicles=self.vehicles, days=self.nights, first_day=FIRST_DAY, frames=self.frames, rig=self.rig,
            faults=faults, seed=self.seed,
        )  # fmt: skip


# Fresh seeds for each release: whoever changes the estimator on what they show draws new ones.
FLEETS = {
    "demo": Fleet("demo", 7981, 6, 10, 40, "vehicle-2:6:radar:yaw:0.8,vehicle-5:6:camera:pitch:-0.5", True),
    "van": Fleet("van-pairs", 7972, 2, 3, 80, "vehicle-2:2:corner_rl:yaw:1.0"),
    "surveyed": Fleet("van-surveyed", 7974, 2, 3, 80),
    "no_lidar": Fleet("no_lidar", 7973, 2, 3, 100),
}


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the fleets")
    parser.add_argument("--fleets", nargs="+", choices=list(FLEETS), default=list(FLEETS))
    parser.add_argument("--out", type=Path, default=RESULTS / "nights.jsonl")
    args = parser.parse_args()
    run_fleets([(name, FLEETS[name]) for name in args.fleets], args.root, args.out)


def run_fleets(fleets: Iterable[tuple[str, Fleet]], root: Path, out: Path) -> list[dict[str, Any]]:
    """Run what is missing of these fleets; print and return their lines."""
    found = []
    for name, fleet in fleets:
        folder = root / f"{name}-{fleet.seed}"
        for night in range(fleet.nights):
            lines = [r for r in _known(out) if (r["row"], r["seed"], r["night"]) == (name, fleet.seed, night)]
            if not lines:
                lines = [{"row": name} | line for line in _night(fleet, night, folder)]
                with out.open("a") as file:
                    file.writelines(json.dumps(line) + "\n" for line in lines)
            found += lines
        aged = out.with_name("aged.jsonl")
        if fleet.is_aged and not any(r["day"]["seed"] == fleet.seed for r in _known(aged)):
            with aged.open("a") as file:
                file.write(json.dumps({"row": name} | _aged(fleet, folder)) + "\n")
    seen = [{"day": {"seed": r["seed"]}, "commit": r["commit"]} for r in found]
    sys.stdout.write(f"{look(out.stem, seen)}\n\n{table(found)}\n")
    return found


def _known(out: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    return [r for r in lines if is_accepted(r["commit"], commit_now(), ())]


def _night(fleet: Fleet, night: int, folder: Path) -> list[dict[str, Any]]:
    """Drive a day, run the night, and measure every vehicle."""
    spec, day, lake = fleet.spec, day_names(FIRST_DAY, fleet.nights)[night], Lake.at(folder / "lake")
    if night == 0:
        shutil.rmtree(folder, ignore_errors=True)
        begin_fleet(spec, folder, "nights")
    for vehicle in range(fleet.vehicles):
        simulate_vehicle_day(spec, vehicle, night, folder)
    began, said = time.process_time(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        logs = str(folder / "logs" / "{vehicle}" / "{day}" / "*")
        code = nightly(
            fleet=folder / "fleet.toml", lake=str(lake), logs=logs, from_day=day, to_day=day, executor="inline",
            pictures=False,
        )  # fmt: skip
    if code not in (0, 3):
        raise RuntimeError(f"nightly ended with {code}: {said.getvalue()[-2000:]}")
    cpu_s = (time.process_time() - began) / fleet.vehicles
    for table_ in CAPTURES.values():
        shutil.rmtree(folder / "lake" / table_.name, ignore_errors=True)  # no lidar, no sweeps
    shutil.rmtree(folder / "logs")
    about = {"rig": fleet.rig, "seed": fleet.seed, "night": night, "commit": commit_now()}
    moved = {f.vehicle: [f.sensor, f.day] for f in spec.faults}
    return [
        about | {"vehicle": name, "moved": moved.get(name), "cpu_s": round(cpu_s, 1)}
        | _measured(lake, name, day, _truth(folder, name, day))
        for name in spec.names
    ]  # fmt: skip


def _aged(fleet: Fleet, folder: Path) -> dict[str, Any]:
    """CPU seconds of audit and states after the fleet's nights, and with a year of such nights before them."""
    young, old = Lake.at(folder / "lake"), folder / "lake-of-a-year"
    shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(folder / "lake", old)
    for schema, kind in ((CALIBRATIONS, CalibrationRecord), (POSES, PoseRow), (OUTCOMES, OutcomeRow)):
        rows: list[Any] = read_records(young, schema, kind)
        earlier = [
            replace(row, day=days_after(row.day, -back), work_key=f"{row.work_key}-{back}")
            for back in range(fleet.nights, 365, fleet.nights)
            for row in rows
        ]
        merge_rows(Lake.at(old), schema, with_months(to_table(earlier, schema), schema))
    audit = ("audit", "--fleet", folder / "fleet.toml", "--lake")
    cpu_s = [round(boresight(*audit, lake)[0], 1) for lake in (folder / "lake", old)]
    return {"day": {"seed": fleet.seed}, "commit": commit_now(), "cpu_s": cpu_s}


def _truth(folder: Path, vehicle: str, day: str) -> dict[str, np.ndarray]:
    """T_base_sensor, of radars where their detections point, by name; the base's own included."""
    known = json.loads((folder / "truth" / vehicle / f"{day}.json").read_text())
    poses = {name: np.array(T) for name, T in known["T_base_sensor"].items()}
    for name, errors in known["radars"].items():
        down = exp_so3(np.array([0.0, errors["elevation_bias_rad"], 0.0]))
        poses[name] = poses[name] @ from_rotation_translation(down, np.zeros(3))
    return poses | {"base": np.eye(4)}


def _measured(lake: Lake, vehicle: str, day: str, truth: Mapping[str, np.ndarray]) -> dict[str, Any]:
    records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day))
    poses = current_poses(read_records(lake, POSES, PoseRow, vehicle=vehicle, day=day))
    states = current_states(read_records(lake, STATES, StateRow, vehicle=vehicle))
    found = read_records(lake, DRIFT, DriftFinding, vehicle=vehicle, day=day)
    kinds = {p.sensor: p.kind for p in poses}
    return {
        "records": [_of_record(r, truth) for r in records],
        "poses": [_of_pose(p, p.sensor, p.reference, kinds, truth) for p in poses if p.sensor != p.reference],
        "states": [
            _of_pose(s, s.sensor, s.parent_frame, kinds, truth)
            for s in states
            if s.sensor is not None and s.sensor != s.parent_frame
        ],
        "red": sorted({f.moved_sensor or "" for f in found if f.vehicle_status == "RED"}),
    }


def _of_record(record: CalibrationRecord, truth: Mapping[str, np.ndarray]) -> dict[str, Any]:
    T_true = inverse(truth[record.parent_frame]) @ truth[record.child_frame]
    targets = DEFAULT_TARGETS if record.targets_m is None else np.asarray(record.targets_m)
    T, certified = transform_of(record), record.determined if record.status == "accepted" else ()
    edge = {"edge": f"{record.parent_frame}-{record.child_frame}", "kind": record.pair}
    return (
        edge
        | {"status": record.status, "faults": record.faults}
        | _errors(record.pair, T, T_true, targets, certified)
    )


def _of_pose(
    row: PoseRow | StateRow,
    sensor: str,
    reference: str,
    kinds: Mapping[str, str],
    truth: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    """Of the reference's points in the sensor: what is certified of a pose."""
    T, T_prior, T_true = transform_of(row), prior_of(row), inverse(truth[sensor]) @ truth[reference]
    given = getattr(row, "targets_m", None)
    kind = f"{kinds[sensor]}_{kinds[reference]}"
    certified = row.determined if row.status in ("accepted", "current") else ()
    found = _errors(
        kind,
        None if T is None else inverse(T),
        T_true,
        DEFAULT_TARGETS if given is None else given,
        certified,
    )
    if T is not None and T_prior is not None:
        off, before = (rotation_angle_rad(T_true @ pose) for pose in (T, T_prior))
        found["is_farther"] = bool(off > before + _FARTHER_RAD)
    return {"sensor": sensor, "kind": kinds[sensor], "status": row.status} | found


def _errors(
    kind: str, T: np.ndarray | None, T_true: np.ndarray, targets: np.ndarray, certified: Sequence[str]
) -> dict[str, Any]:
    if T is None:
        return {"certified": [], "is_wrong": False}
    azimuth, elevation = np.degrees(errors_at_targets(kind, T, T_true, targets)[:2])
    has_radar = "radar" in kind
    limits = {
        "azimuth": _LIMITS.radar_limit_deg if has_radar else _LIMITS.camera_lidar_limit_deg,
        "elevation": _LIMITS.radar_elevation_limit_deg if has_radar else _LIMITS.camera_lidar_limit_deg,
    }
    off = {"azimuth": float(azimuth), "elevation": float(elevation)}
    return {
        "az_deg": round(off["azimuth"], 4), "el_deg": round(off["elevation"], 4), "certified": list(certified),
        "is_wrong": any(off[name] > limits[name] for name in certified),
    }  # fmt: skip


def table(lines: Sequence[Mapping[str, Any]]) -> str:
    """A row per fleet: what is certified and wrong, states by night, sensors RED, farther than the prior, CPU."""
    heads = [
        "fleet", "wrong of certified", "states certified after each night", "moved: RED", "farther than the prior",
    ]  # fmt: skip
    body = []
    for name in dict.fromkeys(r["row"] for r in lines):
        own = [r for r in lines if r["row"] == name]
        nights = {"nights": sorted({r["night"] + 1 for r in own})}
        states = [s for r in own for s in r["states"]]
        farther = f"{sum(s.get('is_farther', False) for s in states)} of {len(states)}"
        cpu_s = f"{np.mean([r['cpu_s'] for r in own]):.0f}"
        cells = (nights_wrong(own, {}), states_after(own, nights), named_red(own, {}), farther, cpu_s)
        body.append([name, *cells])
    return markdown([*heads, "CPU s a vehicle-day"], body)


if __name__ == "__main__":
    main()
