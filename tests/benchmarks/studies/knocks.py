"""Study: knocks of 1 deg on full simulated logs, lost and held days among them, night after night.

    python -m tests.benchmarks.studies.knocks --root FOLDER --seed N [--vehicles 6 --days 8] [--seconds 200]

Every vehicle but the last is knocked once: sensors in turn, axis (yaw or pitch; of radars yaw), sign and day drawn from
the seed; none before the fourth day. Two days of each vehicle are bad ones: dark, at dusk, six frames in all, or
without a lidar, drawn too, the knock's own day not excluded. Each night takes its day's logs through all stages and
audits the fleet as `boresight nightly` does. What is judged: after the last night every knocked vehicle is RED, with
the sensor and the day (+- 1) of its knock, and the last vehicle is not. A stopped study goes on where it stood.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import load_fleet
from pipeline.fleet.nightly import Night, run_night
from pipeline.fleet.pattern import find_vehicle_days
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_vehicle_day, vehicle_names
from pipeline.simulate.logs.fleet_toml import fleet_toml
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, STATE
from pipeline.store.partitions import Lake
from schemas.drift import status_of
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path(__file__).resolve().parent.parent / "results" / "knocks.jsonl"
_SENSORS = ("camera", "radar", "lidar")
_BAD = ("camera:night:1", "camera:dusk:1", "camera:few:6", "lidar:missing:1")
_KNOCK_DEG = 1.0
_FIRST_KNOCK = 3  # counted from 0: a chart needs three days
_FRAMES = 40
_BAD_DAYS = 2


@dataclass(frozen=True)
class Story:
    """What happens to a vehicle: `knocked` is None for the one that nothing happens to; days count from 0."""

    vehicle: str
    knocked: str | None
    axis: str
    turn_deg: float
    day: int
    bad: tuple[tuple[int, str], ...]

    def faults(self) -> list[str]:
        """As `boresight simulate --faults` has it."""
        knock = f"{self.vehicle}:{self.day}:{self.knocked}:{self.axis}:{self.turn_deg}"
        return [f"{self.vehicle}:{d}:{what}" for d, what in self.bad] + ([knock] if self.knocked else [])


def main() -> None:
    """Go on with the study until it is done or the time is up."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--vehicles", type=int, default=6)
    parser.add_argument("--days", type=int, default=8)
    parser.add_argument("--rig", default="demo")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    until = time.monotonic() + args.seconds
    stories = stories_of(args.seed, args.vehicles, args.days)
    spec = FleetSpec(
        vehicles=args.vehicles,
        days=args.days,
        frames=_FRAMES,
        rig=args.rig,
        seed=args.seed,
        faults=parse_faults(
            ",".join(f for s in stories for f in s.faults()), day_names(FleetSpec().first_day, args.days)
        ),
    )
    nights = args.root / "nights.jsonl"
    args.root.mkdir(parents=True, exist_ok=True)
    (args.root / "fleet.toml").write_text(
        fleet_toml("knocks", spec.rig, rig_named(spec.rig), vehicle_names(spec))
    )
    for d, day in enumerate(day_names(spec.first_day, spec.days)):
        if nights.exists() and len(nights.read_text().splitlines()) > d:
            continue
        if not _drive(spec, d, args.root, until):
            return
        told = _night(args.root, day)
        with nights.open("a") as file:
            file.write(json.dumps(told) + "\n")
    lines = [json.loads(line) for line in nights.read_text().splitlines()]
    answers = [judge(story, lines) for story in stories]
    entry = {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "commit": commit_now(),
        "seed": args.seed,
        "rig": args.rig,
    }
    entry |= {"days": args.days, "frames": _FRAMES, "knock_deg": _KNOCK_DEG, "vehicles": answers}
    entry["right"] = f"{sum(a['right'] for a in answers)} of {len(answers)}"
    with args.out.open("a") as file:
        file.write(json.dumps(entry) + "\n")
    print(json.dumps(entry, indent=1))


def stories_of(seed: int, vehicles: int, days: int) -> list[Story]:
    """What is drawn from a seed."""
    rng, stories = np.random.default_rng([seed, 313]), []
    for v in range(vehicles):
        sensor = _SENSORS[v % 3] if v < vehicles - 1 else None
        axis = "yaw" if sensor == "radar" else str(rng.choice(["yaw", "pitch"]))
        turn = float(rng.choice([-1.0, 1.0])) * _KNOCK_DEG
        # Two nights with usable days are left after it, as the charts ask for.
        day = int(rng.integers(_FIRST_KNOCK, days - 2))
        bad = tuple(
            (int(d), str(rng.choice(_BAD))) for d in sorted(rng.choice(days - 1, _BAD_DAYS, replace=False))
        )
        stories.append(Story(f"vehicle-{v + 1}", sensor, axis, turn, day, bad))
    return stories


def _drive(spec: FleetSpec, d: int, root: Path, until: float) -> bool:
    """Logs of a day of all vehicles; False where the time was up."""
    for v, name in enumerate(vehicle_names(spec)):
        done = root / "driven" / f"{name}_{d}"
        if done.exists():
            continue
        if time.monotonic() > until:
            return False
        simulate_vehicle_day(spec, v, d, root)
        done.parent.mkdir(exist_ok=True)
        done.touch()
    return True


def _night(root: Path, day: str) -> dict[str, Any]:
    """Records and statuses of a night; its logs are removed."""
    night = Night(load_fleet(root / "fleet.toml"), Lake.at(root / "lake"))
    days = find_vehicle_days(str(root / "logs" / "{vehicle}" / "{day}" / "*"), day, day)
    pairs = {
        o.vehicle: o.pairs | {"status": o.status} for o in run_night(night, days, "inline", 1, _unwatched)
    }
    task = Task(night.fleet, night.lake, Window(None, day), night.method)
    findings = sorted(AUDIT.run(task).records, key=lambda f: f.vehicle)
    STATE.run(task)
    statuses = {v: asdict(status_of(list(fs))) for v, fs in groupby(findings, lambda f: f.vehicle)}
    for folder in (root / "logs").glob(f"*/{day}"):
        shutil.rmtree(folder)
    return {"day": day, "pairs": pairs, "statuses": statuses}


def _unwatched(*_: Any) -> None:
    """Nobody looks on."""


def judge(story: Story, nights: list[dict[str, Any]]) -> dict[str, Any]:
    """What was said of a vehicle after the last night, whether that is right, and on which night it was first said."""
    last = nights[-1]["statuses"][story.vehicle]
    days = [n["day"] for n in nights]

    def is_right(status: dict[str, Any]) -> bool:
        if story.knocked is None:
            return bool(status["status"] != "RED")
        if status["status"] != "RED" or status["sensor"] != story.knocked or status["since"] not in days:
            return False
        return abs(days.index(status["since"]) - story.day) <= 1

    told = [is_right(n["statuses"].get(story.vehicle, {"status": "UNKNOWN"})) for n in nights]
    knocked_on = days[story.day]
    usable = [d for d, n in enumerate(nights) if "accepted" in n["pairs"].get(story.vehicle, {}).values()]
    return asdict(story) | {
        "knocked_on": knocked_on,
        "told": last,
        "right": told[-1],
        "nights_until_right": told.index(True, story.day) - story.day + 1
        if story.knocked and any(told[story.day :])
        else None,
        "days_with_accepted_records": usable,
    }


if __name__ == "__main__":
    main()
