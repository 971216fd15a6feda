"""Study: is what goes on the car right? Exported files of vehicles' states, night by night, against tomorrow's truth.

    python -m tests.benchmarks.studies.states --keep DIR [--rigs demo duo] [--seed 71001] [--vehicles 12] [--nights 6]
        [--frames 40] [--only-observe] [--again perceive|calibrate|audit] [--out RESULTS.jsonl]

Fleets of twelve vehicles, a rig each (`demo`: one camera, lidar and radar; `duo`: two cameras, a lidar, two
radars and the vehicle frame), drive six days in towns, on motorways and in drawn worlds;
`states_fleet.STORIES` has what happens to them. Every day is simulated, ingested and perceived once; logs and
observations stay in DIR. Then night follows night: calibrate of each vehicle's day, audit of the
fleet, and export of every vehicle's state, by the functions of the commands. Of each file every edge and
every pose is held against the truth of the next day's first frame; beside it stand the errors of the prior
(tf_static) and of the last record. A line per vehicle, night and edge or pose.

A run that was stopped goes on where it stood. After a change of the product: `--again perceive` begins with
the kept logs, `--again calibrate` with the kept observations; `--again audit` makes only charts, states and
files anew, from the kept records. The second rig's seed is one more than the first's. Seeds 71001 to 71099 are
for tuning.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jobs.audit import audit
from jobs.calibrate import calibrate
from jobs.export import export
from jobs.ingest import ingest
from jobs.perceive import perceive
from pipeline.core.errors import ConfigError
from pipeline.export.formats import FORMATS
from pipeline.simulate.fleet import day_names, simulate_vehicle_day
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.store.commits import commit_records
from pipeline.store.current import current_poses, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.captures import CAPTURES
from schemas.features import FEATURES
from schemas.moments import MOMENTS, PERCEIVED
from schemas.poses import POSES, PoseRow
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS, read_results
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.states_fleet import (
    FIRST_DAY,
    STORIES,
    Story,
    fleet_text,
    logged_poses,
    spec_of_day,
    stories_of,
    tomorrows_poses,
)
from tests.benchmarks.studies.states_measures import (
    Entry,
    apart,
    between,
    measure,
    read_file,
    readme_text,
    summary,
)

_OBSERVATIONS = {t.name for t in (MOMENTS, PERCEIVED, *FEATURES.values())}
_RECORDS = ((CALIBRATIONS, CalibrationRecord), (POSES, PoseRow))
# With the numbers of the state; then what a car reads.
_FORMATS = ("json" if "json" in FORMATS else "ros2", "ros2")


@dataclass
class Fleet:
    """One rig's vehicles, the folder that holds their observations, and the CPU that each step took."""

    rig: str
    seed: int
    stories: list[Story]
    frames: int
    nights: int
    folder: Path
    cpu_s: dict[str, list[float]] = field(default_factory=dict)

    @property
    def lake(self) -> Lake:
        """Observations, records and states."""
        return Lake.at(self.folder / "lake")

    @property
    def before(self) -> Path:
        """Lake of records that are put back night by night, while only charts and states are made anew."""
        return self.folder / "before"

    @property
    def about(self) -> dict[str, Any]:
        """Arguments of every command."""
        return {"fleet": self.folder / "fleet.toml", "lake": str(self.folder / "lake")}

    @property
    def days(self) -> list[str]:
        """Names of the driven days."""
        return day_names(FIRST_DAY, self.nights)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Note down the CPU seconds of a step."""
        began = time.process_time()
        yield
        self.cpu_s.setdefault(step, []).append(time.process_time() - began)


def observe(fleet: Fleet) -> None:
    """Simulate, ingest and perceive the vehicle-days that are not there yet."""
    fleet.folder.mkdir(parents=True, exist_ok=True)
    (fleet.folder / "fleet.toml").write_text(fleet_text(fleet.rig, fleet.stories))
    for day in range(fleet.nights):
        for number, story in enumerate(fleet.stories):
            done = fleet.folder / "observed" / f"{story.vehicle}_{fleet.days[day]}"
            if done.exists():
                continue
            began = time.process_time()
            simulate_day(fleet, number, day)
            perceive_day(fleet, number, day)
            done.parent.mkdir(exist_ok=True)
            note = {"commit": commit_now(), "cpu_s": round(time.process_time() - began, 1)}
            done.write_text(json.dumps(note) + "\n")
            print(
                f"{time.strftime('%H:%M:%S')} {fleet.folder.name} {done.name} {note['cpu_s']} CPU s",
                flush=True,
            )


def simulate_day(fleet: Fleet, number: int, day: int) -> None:
    """Logs of a vehicle-day, unless they are there; its truth is written last."""
    vehicle, name = fleet.stories[number].vehicle, fleet.days[day]
    if (fleet.folder / "truth" / vehicle / f"{name}.json").exists():
        return
    shutil.rmtree(fleet.folder / "logs" / vehicle / name, ignore_errors=True)
    with fleet.timed("simulate"):
        spec = spec_of_day(fleet.rig, fleet.seed, fleet.stories, fleet.frames, number, day)
        simulate_vehicle_day(spec, number, day, fleet.folder)


def perceive_day(fleet: Fleet, number: int, day: int) -> None:
    """Observations of a vehicle-day from its logs; pictures and points are dropped."""
    vehicle, name = fleet.stories[number].vehicle, fleet.days[day]
    logs = sorted(map(str, (fleet.folder / "logs" / vehicle / name).iterdir()))
    with fleet.timed("ingest"):
        run_command(ingest, *logs, **fleet.about, vehicle=vehicle, day=name)
    with fleet.timed("perceive"):
        run_command(perceive, **fleet.about, vehicle=vehicle, day=name)
    for table in CAPTURES.values():
        shutil.rmtree(fleet.folder / "lake" / table.name)


def start_again(fleet: Fleet, stage: str) -> None:
    """Remove what nights made: all of it, or (`audit`) put the records aside for `_put_back`.

    `perceive` removes the observations too.
    """
    lake = fleet.folder / "lake"
    if stage == "perceive":
        shutil.rmtree(lake, ignore_errors=True)
        shutil.rmtree(fleet.folder / "observed", ignore_errors=True)
        return
    if stage == "calibrate":
        shutil.rmtree(fleet.before, ignore_errors=True)
    elif not fleet.before.exists():
        fleet.before.mkdir()
        for table, _ in _RECORDS:
            (lake / table.name).rename(fleet.before / table.name)
    for table_folder in lake.iterdir():
        if table_folder.name not in _OBSERVATIONS:
            shutil.rmtree(table_folder)


def night(fleet: Fleet, number: int) -> list[dict[str, Any]]:
    """One night's records, charts, states and files: a line per vehicle and edge or pose."""
    day = fleet.days[number]
    with fleet.timed("calibrate"):
        if not _put_back(fleet, day):
            for story in fleet.stories:
                run_command(calibrate, **fleet.about, vehicle=story.vehicle, day=day)
    with fleet.timed("audit"):
        run_command(audit, **fleet.about, to_day=day)
    rows, run = [], time.strftime("%Y-%m-%d %H:%M:%S")
    for vehicle, story in enumerate(fleet.stories):
        with fleet.timed("export"):
            entries, apart_by = _exported(fleet, story.vehicle, number)
        rows += [{"run": run} | row for row in _rows(fleet, vehicle, number, entries, apart_by)]
    return rows


def _put_back(fleet: Fleet, day: str) -> bool:
    """Commit the records of a day that were put aside; False if there are none."""
    if not fleet.before.exists():
        return False
    for table, row_type in reversed(_RECORDS):
        rows = read_records(Lake.at(fleet.before), table, row_type, day=day)
        commit_records(fleet.lake, table, rows)
    return True


def _exported(fleet: Fleet, vehicle: str, number: int) -> tuple[list[Entry], tuple[float, float] | None]:
    """Entries of the vehicle's file of tonight, and how far the ROS 2 file lies from it."""
    folder = fleet.folder / "files" / f"night-{number + 1}" / vehicle
    shutil.rmtree(folder, ignore_errors=True)
    for what in dict.fromkeys(_FORMATS):
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            try:
                export(what, out=folder / what, lake=fleet.about["lake"], vehicle=vehicle)  # type: ignore[arg-type]
            except ConfigError:  # no state
                return [], None
    entries = read_file(folder / _FORMATS[0])
    return entries, apart(folder / "ros2", entries) if entries else None


def _rows(
    fleet: Fleet, vehicle: int, number: int, entries: list[Entry], apart_by: tuple[float, float] | None
) -> list[dict[str, Any]]:
    story = fleet.stories[vehicle]
    kinds = {s.name: s.kind for s in rig_named(fleet.rig).sensors} | {"base": "base"}
    truth = tomorrows_poses(fleet.rig, fleet.seed, fleet.stories, vehicle, number)
    logged = logged_poses(fleet.rig, fleet.seed, fleet.stories, vehicle)
    about = {
        "commit": commit_now(), "rig": fleet.rig, "seed": fleet.seed,
        "frames": fleet.frames, "vehicle": story.vehicle, "story": story.words, "moved": story.sensor,
        "knock": story.is_knock, "moved_on": story.moved_on, "night": number, "ros2_apart": apart_by,
    }  # fmt: skip
    there = {(e.parent, e.child) for e in entries if e.what == "edge"}
    lacking = [
        Entry("edge", a, b, None, status="not in the file") for a, b in _edges(fleet) if (a, b) not in there
    ]
    rows = []
    for entry in [*entries, *lacking]:
        ends = entry.parent, entry.child
        others = {"prior": between(logged, *ends), "record": _record(fleet, story.vehicle, number, ends)}
        of_ends = kinds[entry.parent], kinds[entry.child]
        rows.append(about | measure(entry, of_ends, truth, others))
    return rows


def _edges(fleet: Fleet) -> list[tuple[str, str]]:
    """Edges of a file: of three sensors all, of more those to the reference, in the order of the kinds."""
    spec = rig_named(fleet.rig)
    if spec.is_short:
        return [("camera", "lidar"), ("camera", "radar"), ("lidar", "radar")]
    top = spec.reference.name
    cameras = [(s.name, top) for s in spec.of_kind("camera")]
    return [*cameras, *((top, s.name) for s in spec.of_kind("radar")), (top, "base")]


def _record(fleet: Fleet, vehicle: str, number: int, ends: tuple[str, str]) -> np.ndarray | None:
    """T_parent_child of the last day until tonight that has poses of both sensors, accepted or held."""
    for day in reversed(fleet.days[: number + 1]):
        rows = current_poses(read_records(fleet.lake, POSES, PoseRow, vehicle=vehicle, day=day))
        poses = {row.sensor: T for row in rows if (T := transform_of(row)) is not None}
        poses |= {row.reference: np.eye(4) for row in rows}
        if {*ends} <= poses.keys():
            return between(poses, *ends)
    return None


def run_command(command: Callable[..., int], *args: Any, **options: Any) -> None:
    """A command, without its output; RuntimeError with it if the command failed."""
    out, log = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(log):
        code = command(*args, **options)
    if code not in (0, 3):
        raise RuntimeError(
            f"{command.__name__} {options}: exit code {code}\n{out.getvalue()}{log.getvalue()}"
        )


def study(fleet: Fleet, args: argparse.Namespace) -> None:
    """Observe a fleet; then the nights that the file of results does not have yet."""
    begun = fleet.folder / "nights.json"  # by which code the lake went through its nights
    if args.again == "perceive":
        start_again(fleet, "perceive")
    observe(fleet)
    if args.only_observe:
        return
    if args.again or not begun.exists():
        start_again(fleet, "audit" if args.again == "audit" else "calibrate")
        begun.write_text("[]")
    done = json.loads(begun.read_text())
    for number in range(len(done), fleet.nights):
        rows = night(fleet, number)
        with args.out.open("a") as out:
            out.writelines(json.dumps(row) + "\n" for row in rows)
        done.append(commit_now())
        begun.write_text(json.dumps(done))
        print(f"{time.strftime('%H:%M:%S')} {fleet.folder.name} night {number + 1}", flush=True)


def results_of(path: Path, fleets: list[Fleet]) -> list[dict[str, Any]]:
    """Lines of these fleets' vehicles and nights: of each night those of its last run."""
    asked = {(f.rig, f.seed, n): {s.vehicle for s in f.stories} for f in fleets for n in range(f.nights)}
    lines = [r for r in read_results(path) if (r["rig"], r["seed"], r["night"]) in asked]
    last = {(r["rig"], r["seed"], r["night"]): r["run"] for r in lines}
    of = [((r["rig"], r["seed"], r["night"]), r) for r in lines]
    return [r for key, r in of if r["run"] == last[key] and r["vehicle"] in asked[key]]


def costs(fleets: list[Fleet]) -> str:
    """CPU seconds of the steps of this run, per vehicle-day, and what all vehicle-days take at that rate."""
    lines = []
    for fleet in fleets:
        days = len(fleet.stories) * fleet.nights
        per_day = {s: sum(v) / (len(v) * (len(fleet.stories) if s in ("calibrate", "audit") else 1))
                   for s, v in fleet.cpu_s.items()}  # fmt: skip
        words = ", ".join(f"{step} {cpu:.1f}" for step, cpu in per_day.items())
        total = sum(per_day.values())
        lines.append(f"{fleet.folder.name}: CPU s a vehicle-day: {words or 'nothing was run'}; "
                     f"{total:.1f} in all, {total * days / 60:.0f} min for {days} vehicle-days")  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--keep", type=Path, required=True, help="folder of the observations, lakes and files"
    )
    parser.add_argument("--rigs", nargs="+", choices=STORIES, default=list(STORIES))
    parser.add_argument("--seed", type=int, default=71001, help="of the first rig; the second has the next")
    parser.add_argument("--vehicles", type=int, default=12)
    parser.add_argument("--nights", type=int, default=6)
    parser.add_argument("--frames", type=int, default=40, help="a vehicle-day, over two drives")
    parser.add_argument("--only-observe", action="store_true")
    parser.add_argument("--again", choices=["perceive", "calibrate", "audit"])
    parser.add_argument("--readme", action="store_true", help="print the rows for the results' tables too")
    parser.add_argument("--out", type=Path, default=RESULTS / "states.jsonl")
    args = parser.parse_args()
    os.nice(5)
    fleets = []
    for rig in args.rigs:
        seed = args.seed + list(STORIES).index(rig)
        stories = stories_of(rig, seed, args.vehicles)
        fleets.append(Fleet(rig, seed, stories, args.frames, args.nights, args.keep / f"{rig}-{seed}"))
        study(fleets[-1], args)
    rows = [] if args.only_observe else results_of(args.out, fleets)
    if rows:
        print(look("states", [{"commit": r["commit"], "day": {"seed": r["seed"]}} for r in rows]))
        print(summary(rows))
        print(
            f"\nFor results/rows.toml and results/README.md:\n\n{readme_text(rows)}\n" if args.readme else ""
        )
    print(costs(fleets))


if __name__ == "__main__":
    main()
