"""Study: cameras on the vehicle frame by their own motion (edge camera_base), against the truth of simulated days.

    python -m tests.benchmarks.studies.motion --root DAYS --seeds 6709 6710 [--rig no_lidar] [--environments urban]
        [--frames 100] [--out tests/benchmarks/results/motion.jsonl]

A day is simulated, ingested and perceived where DAYS does not have it yet; each camera's edge is solved from the prior
that the logs have. A line per camera: errors and stated sigmas of roll, pitch and yaw in axes of the base [deg], and of
the clock [ms], biases included; then the table: RMS of errors, median sigma, RMS of error over sigma.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibrate.edges.camera_base import solve
from pipeline.calibrate.edges.on_base import DaySources, changes_by_left
from pipeline.core.config import load_fleet
from pipeline.core.errors import SolveError
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.estimates import EDGE, EdgeEvidence
from pipeline.rig.graph import BASE, Edge, Sensor
from pipeline.rig.se3 import change_between, inverse
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of, perceived
from schemas.moments import PRIOR
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.looks import look
from tests.makers.stages import ingest_day, perceive_day

DAY = Partition("vehicle-1", "2026-03-02")
AXES = ("roll", "pitch", "yaw")


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the days")
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--rig", default="no_lidar")
    parser.add_argument("--environments", default="urban")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    lines = [line for seed in args.seeds for line in day_of(args, seed)]
    if args.out is not None:
        with args.out.open("a") as file:
            file.writelines(json.dumps(line) + "\n" for line in lines)
    sys.stdout.write(table(lines) + "\n")
    sys.stdout.write(
        look("motion", [{"day": {"seed": r["seed"]}, "commit": r["commit"]} for r in lines]) + "\n"
    )


def day_of(args: argparse.Namespace, seed: int) -> Iterable[dict[str, Any]]:
    """Lines of a day's cameras."""
    folder = args.root / f"{args.rig}_{args.environments}_{args.frames}_{seed}"
    if not (folder / "fleet.toml").exists():
        spec = FleetSpec(
            vehicles=1, days=1, frames=args.frames, rig=args.rig, environments=args.environments, seed=seed
        )
        simulate_fleet(spec, folder)
    fleet, lake = load_fleet(folder / "fleet.toml"), Lake.at(folder / "lake")
    ingest_day(sorted((folder / "logs" / DAY.vehicle / DAY.day).iterdir()), DAY, fleet, lake)
    perceive_day(DAY, fleet, lake)
    truth = json.loads((folder / "truth" / DAY.vehicle / f"{DAY.day}.json").read_text())
    rig, manifest = fleet.rig_of(DAY.vehicle), perceived(lake, DAY)
    assert manifest is not None, "it was perceived just now"
    sources = DaySources(
        rig_prior(manifest.extra[PRIOR], fleet, rig), tuple(rig.lidars), tuple(rig.radars),
        lambda chosen: list(observations_of(lake, DAY, chosen=chosen)),
    )  # fmt: skip
    for camera in rig.cameras:
        yield (
            {"seed": seed, "rig": args.rig, "environment": args.environments, "camera": camera}
            | {"commit": commit_now()}
            | _camera(camera, sources, truth)
        )


def _camera(camera: str, sources: DaySources, truth: dict[str, Any]) -> dict[str, Any]:
    try:
        found, _ = solve(Edge(Sensor(camera, "camera"), BASE), sources)
    except SolveError as err:
        return {"refused": err.reason}
    T_true = np.array(truth["T_base_sensor"][camera])
    error = np.degrees(change_between(inverse(found.T), T_true)[:3])
    sigma = np.degrees(stated_sigmas(found))
    late = found.information[6, 6]
    return {
        "pairs": found.diagnostics["image_pairs"],
        "error_deg": dict(zip(AXES, error.tolist(), strict=True)),
        "sigma_deg": dict(zip(AXES, sigma.tolist(), strict=True)),
        "clock_error_ms": 1e3 * (found.dt_s - truth["dt_s"][camera]) if late > 0 else None,
        "clock_sigma_ms": 1e3 * float(late**-0.5) if late > 0 else None,
        "diagnostics": dict(found.diagnostics),
    }


def stated_sigmas(found: EdgeEvidence) -> np.ndarray:
    """Sigmas of roll, pitch and yaw of T_base_camera with all biases; infinite for what the day does not determine."""
    to_base = changes_by_left(inverse(found.T))
    of_camera = np.linalg.inv(to_base)
    information = np.diag(of_camera.T @ found.information[:6, :6] @ of_camera)[:3]
    biases = found.bias[EDGE] + found.bias[found.edge.parent.name]
    of_bias = np.diag(to_base @ biases @ to_base.T)[:3] + np.diag(found.bias[BASE.name])[:3]
    noise = np.where(information > 1e-3, 1 / np.maximum(information, 1e-12), np.inf)
    return np.sqrt(noise + of_bias)


def table(lines: Sequence[dict[str, Any]]) -> str:
    """A row per camera: RMS error / median sigma / RMS of error over sigma of each axis [deg] and of the clock [ms]."""
    rows = ["| camera | days | roll | pitch | yaw | clock [ms] |", "|---|---|---|---|---|---|"]
    for camera in dict.fromkeys(line["camera"] for line in lines):
        own = [line for line in lines if line["camera"] == camera and "error_deg" in line]
        cells = [
            _cell(
                [
                    (r["error_deg"][axis], r["sigma_deg"][axis])
                    for r in own
                    if np.isfinite(r["sigma_deg"][axis])
                ]
            )
            for axis in AXES
        ]
        clock = [(r["clock_error_ms"], r["clock_sigma_ms"]) for r in own if r["clock_sigma_ms"] is not None]
        rows.append(" | ".join([f"| {camera}", str(len(own)), *cells, _cell(clock, 1)]) + " |")
    return "\n".join(rows)


def _cell(values: Sequence[tuple[float, float]], digits: int = 3) -> str:
    if not values:
        return "-"
    error, sigma = np.array(values).T
    numbers = np.sqrt(np.mean(error**2)), np.median(sigma), np.sqrt(np.mean((error / sigma) ** 2))
    return f"{numbers[0]:.{digits}f} / {numbers[1]:.{digits}f} / {numbers[2]:.1f} ({len(values)})"


if __name__ == "__main__":
    main()
