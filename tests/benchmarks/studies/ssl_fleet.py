"""What the networks are trained and judged on: a simulated fleet with images, and the days of Table 1 with theirs.

    python tests/benchmarks/studies/ssl_fleet.py --root ROOT [--parts fleet table1] [--shard I/N]
    boresight prepare --fleet ROOT/fleet/fleet.toml --lake ROOT/fleet/lake

Every vehicle of the fleet drives on a day of its own, so no two share a mounting, a day or a scene; its seed is no
day's of any other study. ROOT/table1 holds the days that `days.py` names table1, frame for frame the same, but with
their images kept. Days that are there are not made again; logs are thrown away.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

from pipeline.config import load_fleet
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_vehicle_day, vehicle_names
from pipeline.simulate.logs.fleet_toml import fleet_toml
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.store.partitions import Lake, Partition
from tests.benchmarks.studies.days import SETS, generate_day
from tests.makers.stages import ingest_day, perceive_day

__all__ = ["FLEET", "make_fleet_day", "make_fleet_toml"]

_VEHICLES = 32
FLEET = FleetSpec(
    vehicles=_VEHICLES, days=_VEHICLES, first_day="2026-01-05", frames=60, drives=5, rig="paper", seed=1000
)


def make_fleet_toml(root: Path) -> Path:
    """fleet.toml of the training fleet, written once."""
    path = root / "fleet.toml"
    if not path.exists():
        root.mkdir(parents=True, exist_ok=True)
        path.write_text(fleet_toml("synthetic", FLEET.rig, rig_named(FLEET.rig), vehicle_names(FLEET)))
    return path


def make_fleet_day(number: int, root: Path) -> None:
    """Simulate, ingest and perceive the `number`-th vehicle on the `number`-th day, unless it is there."""
    vehicle, day = vehicle_names(FLEET)[number], day_names(FLEET.first_day, FLEET.days)[number]
    partition, done = Partition(vehicle, day), root / "done" / f"{vehicle}.json"
    if done.exists():
        return
    began, fleet, lake = time.process_time(), make_fleet_toml(root), Lake.at(root / "lake")
    logs = root / "logs" / vehicle / day
    shutil.rmtree(logs, ignore_errors=True)
    simulate_vehicle_day(FLEET, number, number, root)
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
    parser.add_argument("--parts", nargs="+", choices=["fleet", "table1"], default=["fleet", "table1"])
    parser.add_argument(
        "--shard", default="0/1", help="I/N: every N-th day from the I-th, for N commands at once"
    )
    args = parser.parse_args()
    shard, shards = (int(v) for v in args.shard.split("/"))
    for part in args.parts:
        days = list(range(_VEHICLES)) if part == "fleet" else SETS["table1"]
        for day in days[shard::shards]:
            began = time.time()
            if isinstance(day, int):
                make_fleet_day(day, args.root / "fleet")
            else:
                generate_day(day, args.root / "table1", images=True)
            print(f"{time.strftime('%H:%M:%S')} {part} {day} ({time.time() - began:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
