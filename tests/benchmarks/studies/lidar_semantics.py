"""Study: lidar points told by the learned range-image network, by geometry and by both, against the simulator.

    boresight train-lidar-semantics --fleet FLEET/fleet.toml --lake FLEET/lake --out RUN
    python tests/benchmarks/studies/lidar_semantics.py --model RUN/lidar_semantics.toml

FLEET is what `ssl_fleet.py` makes; the sweeps here are of another seed: other vehicles, days and scenes. Sweeps only,
no images, so a frame takes a second. Points between 2.5 and 60 m count, as for perception's ground.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.learn.perception_training.lidar_semantics.training import kind_scores
from pipeline.perceive.ground import PointKind, find_ground
from pipeline.perceive.models.range_image import RangeImageSegmenter
from pipeline.simulate.fleet import drive_of, mounting_on
from pipeline.simulate.logs.recording import FIRST_FRAME_S
from pipeline.simulate.sensors.lidar import sweep_lidar
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.simulated_frame import scene_of
from pipeline.simulate.world.casting import World
from tests.benchmarks.studies.ssl_fleet import FLEET

_INLIER_M = 0.15
# Kinds by the simulator's labels, Cityscapes train ids.
_KIND_OF_TRUTH = np.zeros(256, np.uint8)
_KIND_OF_TRUTH[[0, 1, 9]] = PointKind.ROAD, PointKind.FLAT, PointKind.FLAT
_KIND_OF_TRUTH[[2, 3, 4, 5, 6, 7, 8]] = PointKind.OTHER
_KIND_OF_TRUTH[11:19] = PointKind.ROAD_USER


def main() -> None:
    """Measure, print, and write beside the other results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=190, help="tuning seeds are below 200")
    parser.add_argument("--vehicles", type=int, default=6, help="one drive each, urban and highway in turn")
    parser.add_argument("--frames", type=int, default=4, help="of each drive")
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/lidar_semantics.json"))
    args = parser.parse_args()
    scores = measure(args.model, args.seed, args.vehicles, args.frames)
    card = json.loads(args.model.with_suffix(".json").read_text())
    told = {"seed": args.seed, "vehicles": args.vehicles, "frames": args.frames}
    args.out.write_text(json.dumps({"sweeps": told, "scores": scores, "model": card}, indent=1) + "\n")
    print(json.dumps(scores, indent=1))


def measure(model: Path, seed: int, vehicles: int, frames: int) -> dict[str, dict[str, float]]:
    """Scores of each way to tell points, over all sweeps together."""
    segmenter = RangeImageSegmenter(model)
    found: dict[str, list[np.ndarray]] = {}
    for vehicle in range(vehicles):
        for xyz, intensity, label in sweeps(seed, vehicle, frames):
            for name, values in _told(segmenter, xyz, intensity, label).items():
                found.setdefault(name, []).append(values)
    together = {name: np.concatenate(values) for name, values in found.items()}
    truth = together.pop("truth")
    known = truth != PointKind.UNKNOWN
    scores: dict[str, dict[str, float]] = {}
    for name, values in together.items():
        if name.endswith(": road"):
            road = truth[known] == PointKind.ROAD
            iou = np.sum(values[known] & road) / np.sum(values[known] | road)
            scores[name] = {"iou_road": round(float(iou), 4)}
            continue
        binary = name != "network"  # the others tell ground from what is none, and no more
        a, b = values[known], truth[known]
        if binary:
            b = np.where(
                np.isin(b, (PointKind.ROAD, PointKind.FLAT)), PointKind.FLAT, PointKind.OTHER
            ).astype(np.uint8)
        scores[name] = {k: round(v, 4) for k, v in kind_scores(a, b).items()}
        ground = np.isin(a, (PointKind.ROAD, PointKind.FLAT))
        objects = ~np.isin(truth[known], (PointKind.ROAD, PointKind.FLAT))
        scores[name]["iou_objects"] = round(float(np.sum(~ground & objects) / np.sum(~ground | objects)), 4)
    return scores | {"points": {"all": float(known.sum())}}


def sweeps(seed: int, vehicle: int, frames: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points, intensity and the simulator's labels of one drive's sweeps, seconds apart."""
    spec = replace(FLEET, seed=seed, rate_hz=0.5)
    drive = drive_of(spec, vehicle, 0, 0, frames)
    world, scene, rig = World(drive), scene_of(drive), rig_named(spec.rig)
    mounting, rng, made = mounting_on(spec, vehicle, 0), np.random.default_rng([seed, vehicle]), []
    for k in range(frames):
        stamp = FIRST_FRAME_S + k / spec.rate_hz
        moment = world.moment(stamp - rig["lidar"].sheet.sweep_s / 2)
        sweep = sweep_lidar(moment, scene.ego, mounting["lidar"].T_vehicle, rig["lidar"].sheet, stamp, rng)
        made.append((sweep.xyz_m, sweep.intensity, sweep.label))
    return made


def _told(
    segmenter: RangeImageSegmenter, xyz: np.ndarray, intensity: np.ndarray, label: np.ndarray
) -> dict[str, Any]:
    kinds = segmenter.kinds(xyz, intensity)
    range_m = np.hypot(xyz[:, 0], xyz[:, 1])
    counts = (range_m > 2.5) & (range_m < 60.0)
    ways = {"geometry": None, "network and geometry": kinds}
    told: dict[str, Any] = {"truth": _KIND_OF_TRUTH[label][counts], "network": kinds[counts]}
    for name, kind in ways.items():
        ground = find_ground(xyz, _INLIER_M, np.random.default_rng(0), kind)
        told[name] = np.where(ground.is_ground, PointKind.FLAT, PointKind.OTHER).astype(np.uint8)[counts]
        told[f"{name}: road"] = ground.is_road[counts]
    return told


if __name__ == "__main__":
    main()
