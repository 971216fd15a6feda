"""Study: days of rigs of many sensors, from logs to a pose of every sensor, held against the simulator's truth.

    python tests/benchmarks/studies/rig_days.py DAY... --lake FOLDER [--out RESULTS.jsonl]

Each DAY is a folder of `boresight simulate --rig van`: fleet.toml, logs/, truth/. Lakes are made below --lake
and kept. A row per sensor: status, errors of azimuth and elevation at targets that lie straight ahead of it [deg], with
the sigmas that the pose states, how far it is in sigmas (all six together, per unknown), CPU of calibrate [s].
"""

from __future__ import annotations

import argparse
import json
import resource
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import load_fleet
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, log_se3, transform_points
from pipeline.geometry.spherical import camera_direction_angles, from_spherical, to_spherical, wrap_angle
from pipeline.store.current import current_poses, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.poses import POSES, PoseRow
from schemas.versions import CODE_VERSION
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

_AHEAD = from_spherical(np.array([[np.radians(-10), 0, 15.0], [np.radians(8), 0, 25.0], [0.0, 0, 40.0]]))
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def main() -> None:
    """Write a row per sensor of each day."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("day", type=Path, nargs="+")
    parser.add_argument("--lake", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = [row for day in asked.day for row in rows_of_day(day, asked.lake / day.name)]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    if asked.out:
        asked.out.write_text(text)
    print(text, end="")


def rows_of_day(folder: Path, lake_path: Path) -> Iterator[dict[str, Any]]:
    """A row for each sensor but the reference, of each vehicle-day of a folder."""
    fleet, lake = load_fleet(folder / "fleet.toml"), Lake.at(lake_path)
    for path in sorted(folder.glob("truth/*/*.json")):
        partition = Partition(path.parent.name, path.stem)
        logs = sorted((folder / "logs" / partition.vehicle / partition.day).iterdir())
        ingest_day(logs, partition, fleet, lake)
        perceive_day(partition, fleet, lake)
        began_s = _cpu_s()
        calibrate_day(partition, fleet, lake, method="joint")
        spent_s, truth = _cpu_s() - began_s, json.loads(path.read_text())
        found = read_records(lake, POSES, PoseRow, vehicle=partition.vehicle, day=partition.day)
        for pose in current_poses(found):
            if pose.sensor != pose.reference:
                about = {"code_version": CODE_VERSION, "seed": truth["seed"], "day": partition.day}
                yield about | {"cpu_s": round(spent_s, 1)} | row_of(pose, true_poses(truth))


def true_poses(truth: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """T_base_sensor by name at the end of a day; a radar's is that of its detections, which all point up or down."""
    found = {"base": np.eye(4)}
    for name, T in truth["at_end_of_day"]["T_base_sensor"].items():
        bias_rad = truth["radars"].get(name, {}).get("elevation_bias_rad", 0.0)
        found[name] = np.array(T) @ from_rotation_translation(
            exp_so3(np.array([0.0, bias_rad, 0.0])), np.zeros(3)
        )
    return found


def row_of(pose: PoseRow, base: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What a pose says beside the truth, which `true_poses` has; without numbers where nothing was computed."""
    told = {"sensor": pose.sensor, "kind": pose.kind, "status": pose.status, "reason": pose.reason}
    T, covariance = transform_of(pose), pose.covariance
    if T is None or covariance is None or pose.azimuth_sigma_rad is None or pose.elevation_sigma_rad is None:
        return told
    true = inverse(base[pose.reference]) @ base[pose.sensor]
    points = transform_points(true, _AHEAD @ _OPTICAL if pose.kind == "camera" else _AHEAD)
    angles = camera_direction_angles if pose.kind == "camera" else to_spherical
    apart = angles(transform_points(inverse(T), points)) - angles(transform_points(inverse(true), points))
    azimuth_deg, elevation_deg = np.degrees(np.abs(wrap_angle(apart[:, :2])).mean(axis=0))
    off = log_se3(true @ inverse(T))
    return told | {
        "az_deg": round(float(azimuth_deg), 4),
        "el_deg": round(float(elevation_deg), 4),
        "az_sigma_deg": round(float(np.degrees(pose.azimuth_sigma_rad)), 4),
        "el_sigma_deg": round(float(np.degrees(pose.elevation_sigma_rad)), 4),
        "position_m": round(float(np.linalg.norm(T[:3, 3] - true[:3, 3])), 4),
        "chi2_per_dof": round(float(off @ np.linalg.solve(covariance, off)) / 6, 3),
        "determined": pose.determined,
        "edges": pose.edges,
    }


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
