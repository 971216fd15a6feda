"""What the networks are trained and judged on: simulated fleets with images, and the days of Table 1 with theirs.

    python tests/benchmarks/studies/ssl_fleet.py --root ROOT [--parts fleet rigs table1] [--shard I/N]
    boresight prepare --fleet ROOT/fleet/fleet.toml --lake ROOT/fleet/lake

Every vehicle of a fleet drives on a day of its own, so no two share a mounting, a day or a scene; its seed is no
day's of any other study. ROOT/fleet has the paper's rig; of ROOT/rigs every vehicle has a rig, a world and a segmenter
of its own, drawn from a seed, and every third drives at dusk. ROOT/table1 holds the days that `days.py` names table1,
frame for frame the same, but with their images kept. Days that are there are not made again; logs are thrown away.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.config import load_fleet
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_vehicle_day, vehicle_names
from pipeline.simulate.logs.fleet_toml import fleet_toml, mixed_fleet_toml
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.semantics import SemanticsSpec
from pipeline.store.partitions import Lake, Partition
from tests.benchmarks.studies.days import SETS, generate_day
from tests.makers.stages import ingest_day, perceive_day

__all__ = ["FLEET", "RIGS", "make_fleet_day", "make_fleet_toml", "spec_of"]

FLEET = FleetSpec(vehicles=32, days=32, first_day="2026-01-05", frames=60, drives=5, rig="paper", seed=1000)
# Rigs, worlds and segmenters are those of seeds 7000, 7001, ...
RIGS = FleetSpec(vehicles=80, days=80, first_day="2026-01-05", frames=30, drives=3, seed=7000)
_SOURCES = {"fleet": FLEET, "rigs": RIGS}
_WORLDS = ("urban", "highway", "mixed")


def spec_of(part: str, number: int) -> FleetSpec:
    """What the `number`-th vehicle of a fleet drives, and on what."""
    spec = _SOURCES[part]
    if part == "fleet":
        return spec
    seed, day = spec.seed + number, day_names(spec.first_day, spec.days)[number]
    dusk = f"{vehicle_names(spec)[number]}:{day}:camera:dusk:1" if number % 3 == 2 else ""
    return replace(
        spec, rig=f"random-{seed}", seed=seed, semantics=_segmenter(seed),
        environments=_WORLDS[(number // 2) % 3], faults=parse_faults(dusk, day_names(spec.first_day, spec.days)),
    )  # fmt: skip


def _segmenter(seed: int) -> SemanticsSpec:
    """From half as good as the simulator's own to a little better."""
    rng = np.random.default_rng([seed, 62])
    worse = float(rng.uniform(0.7, 2.0))
    return SemanticsSpec(
        boundary_px=0.9 * worse,
        swell=float(rng.uniform(0.2, 0.6)),
        confusion=0.05 * worse,
        miss=0.04 * worse,
        box_jitter=0.022 * worse,
    )


def make_fleet_toml(part: str, root: Path) -> Path:
    """fleet.toml of a training fleet, written once."""
    path, spec = root / "fleet.toml", _SOURCES[part]
    if not path.exists():
        names = vehicle_names(spec)
        root.mkdir(parents=True, exist_ok=True)
        rigs = {name: rig_named(spec_of(part, number).rig) for number, name in enumerate(names)}
        one = fleet_toml("synthetic", spec.rig, rig_named(spec.rig), names)
        path.write_text(one if part == "fleet" else mixed_fleet_toml("synthetic", rigs))
    return path


def make_fleet_day(part: str, number: int, root: Path) -> None:
    """Simulate, ingest and perceive the `number`-th vehicle on the `number`-th day, unless it is there."""
    spec = spec_of(part, number)
    vehicle, day = vehicle_names(spec)[number], day_names(spec.first_day, spec.days)[number]
    partition, done = Partition(vehicle, day), root / "done" / f"{vehicle}.json"
    if done.exists():
        return
    began, fleet, lake = time.process_time(), make_fleet_toml(part, root), Lake.at(root / "lake")
    logs = root / "logs" / vehicle / day
    shutil.rmtree(logs, ignore_errors=True)
    simulate_vehicle_day(spec, number, number, root)
    config = load_fleet(fleet)
    ingest_day(sorted(logs.iterdir()), partition, config, lake)
    result = perceive_day(partition, config, lake)
    shutil.rmtree(logs)
    done.parent.mkdir(parents=True, exist_ok=True)
    done.write_text(
        json.dumps({"kept_frames": result.rows, "cpu_s": round(time.process_time() - began, 1)}) + "\n"
    )


def main() -> None:
    """Make what is missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--parts", nargs="+", choices=[*_SOURCES, "table1"], default=["fleet", "table1"])
    parser.add_argument(
        "--shard", default="0/1", help="I/N: every N-th day from the I-th, for N commands at once"
    )
    args = parser.parse_args()
    shard, shards = (int(v) for v in args.shard.split("/"))
    for part in args.parts:
        days = SETS["table1"] if part == "table1" else list(range(_SOURCES[part].vehicles))
        for day in days[shard::shards]:
            began = time.time()
            if isinstance(day, int):
                make_fleet_day(part, day, args.root / part)
            else:
                generate_day(day, args.root / "table1", images=True)
            print(f"{time.strftime('%H:%M:%S')} {part} {day} ({time.time() - began:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
