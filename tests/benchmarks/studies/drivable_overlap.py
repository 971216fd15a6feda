"""Study: how far the radar's drivable area agrees with the lidar's ground, by a network and by geometry.

    python -m tests.benchmarks.studies.drivable_overlap DAY... [--model MANIFEST]

DAY are folders of `days.generate_day`; observations are enough. The lidar's drivable cells, carried to the radar by the
day's prior, are the labels that networks learn from (`pipeline/learn/perception/radar_drivable`); the overlap is their
IoU with each answer over all sampled scans, cells that the lidar did not see apart.
"""

from __future__ import annotations

import argparse
import json
import time
import tomllib
from pathlib import Path

import numpy as np

from pipeline.config import load_fleet
from pipeline.geometry.radar_grid import sector_mask, sector_of
from pipeline.learn.perception.radar_drivable.samples import DrivableSamples, samples_of_day
from pipeline.learn.perception.radar_drivable.training import area_iou
from pipeline.perceive.models.session import open_session
from pipeline.shipped_models import shipped_manifest
from pipeline.store.partitions import Lake
from pipeline.store.views import perceived_days
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS

__all__ = ["overlaps"]


def main() -> None:
    """Print and write the overlaps of every day."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("days", nargs="+", type=Path)
    parser.add_argument("--model", type=Path, default=shipped_manifest("radar_drivable"))
    parser.add_argument("--frames", type=int, default=20, help="of each day, evenly spread")
    parser.add_argument("--out", type=Path, default=RESULTS / "drivable_overlap.json")
    args = parser.parse_args()
    found = {}
    for folder in args.days:
        lake = Lake.at(folder / "lake")
        [day] = perceived_days(lake)
        samples = samples_of_day(load_fleet(folder / "fleet.toml"), lake, day, args.frames)
        found[folder.name] = overlaps(samples, args.model)
        print(folder.name, found[folder.name], flush=True)
    about = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "model": args.model.name}
    args.out.write_text(json.dumps(about | {"iou": found}, indent=1) + "\n")


def overlaps(samples: DrivableSamples, model: Path) -> dict[str, float]:
    """IoU of the network behind a manifest and of geometry with the labels."""
    session = open_session(model.parent / tomllib.loads(model.read_text())["path"], model)
    name = session.get_inputs()[0].name
    answers = [session.run(None, {name: f[None].astype(np.float32)})[0][0] for f in samples.features]
    sectors = np.stack([sector_mask(*sector_of(answer)) for answer in answers])
    return {
        "network": round(area_iou(sectors, samples.label), 3),
        "geometry": round(area_iou(samples.geometric, samples.label), 3),
    }


if __name__ == "__main__":
    main()
