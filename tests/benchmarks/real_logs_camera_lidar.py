"""Camera-lidar of method `joint` against a reference calibration: recovery from perturbed starts, halves, time.

    python tests/benchmarks/real_logs_camera_lidar.py LAKE VEHICLE DAY [--truth TRUTH.json] [--seeds 10] [--frames 100]

Reads table observations. The reference is the truth file, else the logged prior (on real logs no truth: agreement finer
than what that calibration is good for means nothing). Prints one line per run and the shares within the goals.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import estimate_camera_lidar
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_covariance
from pipeline.geometry.se3 import inverse, log_so3, perturb_exactly, transform_points
from pipeline.geometry.spherical import camera_direction_angles
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation

# Targets in the common field of view at 15, 25 and 40 m, lidar frame (the paper's reflectors stood there).
TARGETS_M = np.array([[15.0, 2.0, -0.5], [25.0, -3.0, -0.5], [40.0, 1.0, 0.0]])
STARTS = ((2.0, 0.1), (5.0, 0.2))


def azimuth_elevation_deg(T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
    """Mean absolute difference of the targets' azimuth and elevation in the camera [deg]."""
    a, b = (camera_direction_angles(transform_points(T, TARGETS_M)) for T in (T_a, T_b))
    return np.degrees(np.abs(a - b)).mean(0)


def reference_of(rows: list[Observation], truth: Path | None) -> tuple[np.ndarray, np.ndarray]:
    """T_camera_lidar and T_lidar_radar to compare with."""
    if truth is not None:
        known = json.loads(truth.read_text())
        return np.array(known["T_camera_lidar"]), np.array(known["T_lidar_radar"])
    return rows[0].priors["camera_lidar"], rows[0].priors["lidar_radar"]


def evenly(rows: list[Observation], count: int) -> list[Observation]:
    """About `count` rows, evenly spread."""
    return [
        rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))
    ]


def run(
    rows: list[Observation],
    T_cl: np.ndarray,
    T_lr: np.ndarray,
    start: tuple[float, float],
    seed: int,
    label: str,
) -> tuple[np.ndarray, float, float, np.ndarray]:
    """One estimate from a perturbed start: pose, dt, its sigma, az/el error."""
    rng = np.random.default_rng(seed)
    rotation = np.radians(start[0])
    prior = Prior(
        perturb_exactly(T_cl, rotation, start[1], rng),
        perturb_exactly(T_lr, rotation, start[1], rng),
        max(float(np.radians(2.0)), float(rotation)),
        max(0.05, start[1]),
    )
    begun = time.process_time()
    e = estimate_camera_lidar(rows, prior, SolveConfig(), np.random.default_rng(100 + seed))
    cpu_s = time.process_time() - begun
    error = azimuth_elevation_deg(e.T, T_cl)
    sigma = np.sqrt(np.diag(change_covariance(e.T, e.covariance)))
    off = np.concatenate([log_so3((e.T @ inverse(T_cl))[:3, :3]), e.T[:3, 3] - T_cl[:3, 3]])
    print(
        f"{label:6s} start {start[0]:.0f} deg {start[1]:.1f} m seed {seed} | az {error[0]:.3f} el {error[1]:.3f} deg"
        f" | rot {np.degrees(off[:3]).round(2)} +- {np.degrees(sigma[:3]).round(2)} deg"
        f" | t {(100 * off[3:]).round(1)} +- {(100 * sigma[3:]).round(1)} cm"
        f" | dt {1e3 * (e.time_offset_s or 0):.1f} +- {1e3 * (e.time_offset_sigma_s or 0):.1f} ms"
        f" | focal {e.diagnostics['focal_scale']:.4f} | {cpu_s:.1f} s CPU",
        flush=True,
    )
    return e.T, e.time_offset_s or 0.0, e.time_offset_sigma_s or 0.0, error


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lake", type=Path)
    parser.add_argument("vehicle")
    parser.add_argument("day")
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--frames", type=int, default=100)
    args = parser.parse_args()
    rows = list(observations_of(Lake(args.lake), Partition(args.vehicle, args.day)))
    T_cl, T_lr = reference_of(rows, args.truth)
    for start in STARTS:
        errors = [run(evenly(rows, args.frames), T_cl, T_lr, start, s, "all")[3] for s in range(args.seeds)]
        within = np.mean([(e[0] <= 0.15) & (e[1] <= 0.20) for e in errors])
        mean, worst = np.mean(errors, 0).round(3), np.max(errors, 0).round(3)
        print(f"== {start}: mean az/el {mean}, worst {worst}, within .15/.20: {within:.0%}")
        halves = {
            "even": rows[::2],
            "odd": rows[1::2],
            "first": rows[: len(rows) // 2],
            "last": rows[len(rows) // 2 :],
        }
        for s in range(min(args.seeds, 4)):
            found = {name: run(part, T_cl, T_lr, start, s, name) for name, part in halves.items()}
            for a, b in (("even", "odd"), ("first", "last")):
                apart = azimuth_elevation_deg(found[a][0], found[b][0])
                dt = 1e3 * (found[a][1] - found[b][1])
                sigma = 1e3 * np.hypot(found[a][2], found[b][2])
                print(f"-- {a}/{b}: az {apart[0]:.3f} el {apart[1]:.3f} deg, dt {dt:+.1f} +- {sigma:.1f} ms")


if __name__ == "__main__":
    main()
