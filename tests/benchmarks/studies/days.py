"""Simulated vehicle-days for the studies: generated and perceived once, calibrated as often as a study likes.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets table1 coverage verdict offsets
    python tests/benchmarks/studies/days.py adopt --root DAYS --fleet astyx.toml --lake LAKE --vehicle V --day D
    python tests/benchmarks/studies/days.py gather --root DAYS --sets dev --out FLEET

Of a day only its truth, its fleet.toml and its observations stay on the disk; days that are there are not made again.
`adopt` puts a real day, ingested and perceived, beside them: its logged calibration stands in for the truth that nobody
knows. `gather` makes one fleet of the days of some sets, each a vehicle, for commands that learn from a lake. With
`--lidar-semantics shipped:lidar_semantics` that network labels the lidar's points, where geometry does otherwise.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core.config import FleetConfig, load_fleet
from pipeline.rig.day_prior import read_prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, fleet_toml, simulate_fleet
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS
from schemas.captures import CAPTURES
from schemas.features import FEATURES
from schemas.moments import MOMENTS, PERCEIVED
from schemas.observations import Observation
from tests.benchmarks.studies.commits import commit_now
from tests.makers.stages import ingest_day, perceive_day

__all__ = ["REAL", "SETS", "Day", "DaySpec", "adopt_day", "generate_day", "label_by_network", "load_day"]

VEHICLE, DATE = "vehicle-1", "2026-03-02"
_FINISHED = "done.json"


@dataclass(frozen=True)
class DaySpec:
    """One simulated vehicle-day; `fault` is `sensor:kind:amount` as `boresight simulate --faults` has it."""

    seed: int
    environment: str
    frames: int = 40
    rig: str = "paper"
    fault: str = ""

    @property
    def name(self) -> str:
        """Folder of the day."""
        fault = "_" + self.fault.replace(":", "-") if self.fault else ""
        return f"{self.rig}_{self.environment}_{self.frames}_{self.seed}{fault}"


@dataclass(frozen=True, eq=False)
class Day:
    """A day as a study needs it."""

    spec: DaySpec
    rows: list[Observation]
    truth: dict[str, object]
    fleet: FleetConfig
    made_by: dict[str, str]  # commits that simulated and perceived it

    def true_of(self, pair: str) -> np.ndarray:
        """True transform of a pair."""
        return np.array(self.truth[f"T_{pair}"], np.float64)

    def pointing_of(self, pair: str) -> np.ndarray:
        """The transform that puts a radar's detections where they came from; the true one of other pairs.

        A radar that measures all elevations too high by b points as one that is mounted right and turned down by b.
        """
        T, bias_rad = self.true_of(pair), self.truth.get("radar_elevation_bias_rad")
        if not pair.endswith("radar") or not isinstance(bias_rad, float):
            return T
        down = exp_so3(np.array([0.0, bias_rad, 0.0]))
        return T @ from_rotation_translation(down, np.zeros(3))


def generate_day(spec: DaySpec, root: Path, *, images: bool = False, lidar_semantics: str = "") -> Path:
    """Simulate, ingest and perceive a day unless it is there; returns its folder. `images` keeps images and points."""
    folder = root / spec.name
    if (folder / _FINISHED).exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    began, commit = time.process_time(), commit_now()
    faults = f"{VEHICLE}:{DATE}:{spec.fault}" if spec.fault else ""
    simulate_fleet(
        FleetSpec(
            vehicles=1, days=1, first_day=DATE, frames=spec.frames, rig=spec.rig,
            environments=spec.environment, faults=parse_faults(faults, day_names(DATE, 1)), seed=spec.seed,
        ),
        folder,
    )  # fmt: skip
    fleet, lake, partition = folder / "fleet.toml", Lake.at(folder / "lake"), Partition(VEHICLE, DATE)
    if lidar_semantics:
        label_by_network(fleet, lidar_semantics)
    config = load_fleet(fleet)
    logs = sorted((folder / "logs" / VEHICLE / DATE).iterdir())
    ingest_day(logs, partition, config, lake)
    result = perceive_day(partition, config, lake)
    shutil.rmtree(folder / "logs")
    if not images:
        for table in (MOMENTS, *CAPTURES.values()):
            shutil.rmtree(folder / "lake" / table.name)
    note = asdict(spec) | {"kept_frames": result.rows, "cpu_s": round(time.process_time() - began, 1)}
    note |= {"simulated_by": commit, "perceived_by": commit}
    (folder / _FINISHED).write_text(json.dumps(note) + "\n")
    return folder


def label_by_network(fleet: Path, network: str) -> None:
    """Write into a simulated fleet.toml that this network labels the lidar's points."""
    line = f'semantics = {{ source = "onnx", segmenter = "{network}" }}'
    text = fleet.read_text()
    fleet.write_text(re.sub(r"^(\[rigs\.\S+\.lidar\])$", rf"\1\n{line}", text, flags=re.MULTILINE))


def adopt_day(
    fleet_file: Path,
    lake: str,
    partition: Partition,
    root: Path,
    spec: DaySpec | None = None,
    truth_file: Path | None = None,
) -> Path:
    """Put a perceived day of another origin among the generated ones.

    Its logged calibration is the reference, unless a file says the truth.
    """
    rows, spec = list(observations_of(Lake.at(lake), partition)), spec or REAL
    given = read_prior(rows, load_fleet(fleet_file), partition.vehicle)
    folder = root / spec.name
    shutil.rmtree(folder, ignore_errors=True)
    truth = folder / "truth" / partition.vehicle / f"{partition.day}.json"
    truth.parent.mkdir(parents=True)
    if truth_file is not None:
        known = {k: np.array(T) for k, T in json.loads(truth_file.read_text()).items() if k.startswith("T_")}
        given = replace(given, T_camera_lidar=known["T_camera_lidar"], T_lidar_radar=known["T_lidar_radar"])
    truth.write_text(json.dumps({f"T_{pair}": given.of(pair).tolist() for pair in PAIRS}))
    shutil.copy(fleet_file, folder / "fleet.toml")
    copy_perceived(Lake.at(lake), partition, Lake.at(folder / "lake"), partition)
    note = asdict(spec) | {"vehicle": partition.vehicle, "day": partition.day, "kept_frames": len(rows)}
    note |= {"simulated_by": "", "perceived_by": commit_now()}
    (folder / _FINISHED).write_text(json.dumps(note) + "\n")
    return folder


def copy_perceived(source: Lake, day: Partition, target: Lake, copy: Partition) -> None:
    """What perception found on a day, into another lake, perhaps under another name."""
    for table in (PERCEIVED, *FEATURES.values()):
        if source.exists() and Path(source.folder(table.name, day)).exists():
            shutil.copytree(
                source.folder(table.name, day), target.folder(table.name, copy), dirs_exist_ok=True
            )


def gather_days(specs: Sequence[DaySpec], root: Path, out: Path) -> Path:
    """Observations of generated days of one rig as a fleet of their own: FLEET/fleet.toml and FLEET/lake."""
    [rig] = {spec.rig for spec in specs}
    for spec in specs:
        source, target = Lake.at(root / spec.name / "lake"), Lake.at(out / "lake")
        copy_perceived(source, Partition(VEHICLE, DATE), target, Partition(spec.name, DATE))
    path = out / "fleet.toml"
    path.write_text(fleet_toml("gathered", rig, rig_named(rig), [spec.name for spec in specs]))
    return path


def load_day(spec: DaySpec, root: Path) -> Day:
    """Observations, truth and configuration of a generated (or adopted) day."""
    folder = root / spec.name
    if not (folder / _FINISHED).exists():
        raise SystemExit(f"{folder} is not there: run `days.py generate --root {root}` first")
    note = json.loads((folder / _FINISHED).read_text())
    partition = Partition(note.get("vehicle", VEHICLE), note.get("day", DATE))
    return Day(
        spec,
        list(observations_of(Lake.at(folder / "lake"), partition)),
        json.loads((folder / "truth" / partition.vehicle / f"{partition.day}.json").read_text()),
        load_fleet(folder / "fleet.toml"),
        {name: note.get(name, "unknown") for name in ("simulated_by", "perceived_by")},
    )


def _both(first: int, count: int, **fields: object) -> list[DaySpec]:
    """Urban and highway in turn."""
    return [
        DaySpec(first + i, ("urban", "highway")[i % 2], **fields)  # type: ignore[arg-type]
        for i in range(count)
    ]


def _turned(first: int) -> list[DaySpec]:
    """A sensor that hangs 12 deg off in its bracket, twice the default search range."""
    faults = [f"camera:yaw:{sign}12" for sign in ("", "-")]
    faults += [f"{sensor}:{axis}:12" for sensor in ("radar", "lidar") for axis in ("yaw", "pitch")]
    return [DaySpec(first + i, ("urban", "highway")[i % 2], fault=fault) for i, fault in enumerate(faults)]


def _a_day_of_each_rig(first: int, environments: Sequence[str], *, dusk: int) -> list[DaySpec]:
    """Eight rigs; every fourth day at dusk, from number `dusk` on."""
    rigs = ("paper", "ring16", "demo", "spin128", "pinhole", "rosette", "fisheye", "truck")
    return [
        DaySpec(first + i, environments[i % 3], 100, rig, "camera:dusk:1" if i % 4 == dusk else "")
        for i, rig in enumerate(rigs)
    ]


def _worlds(first: int, count: int, frames: int = 60) -> list[DaySpec]:
    """Another world with another rig for every seed."""
    return [DaySpec(seed, f"world-{seed}", frames, f"random-{seed}") for seed in range(first, first + count)]


def _rows(first: int, frames: int = 60) -> list[DaySpec]:
    """Lidars of few rows and of many, narrow and full turns, a street and a motorway each."""
    rigs = [f"rows-{rows}-{degrees}" for rows in (16, 32, 64, 128) for degrees in (60, 360)]
    return [DaySpec(first + i, ("urban", "highway")[i // 8], frames, rig) for i, rig in enumerate(2 * rigs)]


REAL = DaySpec(0, "real", 0, "real")

# Seeds below 200 are for tuning. Seeds 200 to 804 were the test days of 0.3.0: the estimator was changed on what they
# showed, so they are burnt, as are 3200 to 3709 (0.4.0) and 4100 to 4105 (the camera-radar rival's share was set on
# them). Those below are looked at once, with code that no longer changes; whoever changes the estimator on what they
# show draws new ones.
SETS: dict[str, list[DaySpec]] = {
    "dev": _both(110, 16),
    "dev-bad": [
        DaySpec(130, "urban", fault="camera:labels:1"),
        DaySpec(131, "highway", fault="camera:labels:1"),
        DaySpec(132, "urban", fault="camera:night:1"),
        DaySpec(133, "highway", fault="camera:night:1"),
        DaySpec(134, "urban", fault="camera:time:0.08"),
        DaySpec(135, "highway", fault="camera:time:0.08"),
        DaySpec(136, "urban", fault="radar:time:0.08"),
        DaySpec(137, "highway", fault="radar:time:0.08"),
        DaySpec(138, "urban", fault="radar:yaw:12"),
        DaySpec(139, "highway", fault="camera:yaw:12"),
    ],
    # Other cars, all on the same drives; `mixed` is town and highway in turn, drive by drive.
    "dev-rigs": [
        *(
            DaySpec(183, "mixed", rig=rig)
            for rig in (
                "demo",
                "ring16",
                "corner-left",
                "corner-right",
                "spin128",
                "rosette",
                "fisheye",
                "pinhole",
                "rolling",
                "truck",
                "bumper",
                "tilted",
            )
        ),
        *(
            DaySpec(183, "mixed", rig="demo", fault=fault)
            for fault in ("camera:centre:4", "camera:dusk:1", "camera:night:1")
        ),
    ],
    # Rigs, worlds and dusk combined in another order than in the test set `basin`.
    "dev-basin": [
        DaySpec(
            184 + i,
            ("highway", "urban", "mixed")[i % 3],
            rig=rig,
            fault="camera:dusk:1" if i % 4 == 1 else "",
        )
        for i, rig in enumerate(
            2 * ("ring16", "spin128", "demo", "fisheye", "pinhole", "rosette", "truck", "paper")
        )
    ],
    "dev-worlds": _worlds(60, 16),
    "dev-views": [
        DaySpec(76 + i, world, 60, rig)
        for i, (rig, world) in enumerate(
            (rig, world)
            for rig in ("hdl64", "keyhole", "telephoto")
            for world in ("suburb", "country", "alley")
        )
    ],
    "worlds": _worlds(6400, 128),
    "rows": _rows(6600),
    # Of 60 frames some 40 are fitted. Of these about 100 are, as of the days that the README asks for.
    "rows-full": _rows(6640, 150),
    "worlds-full": _worlds(6660, 32, 150),
    "day-cost": [DaySpec(3800, "urban", 100), DaySpec(3801, "highway", 100)],
    "table1": [DaySpec(4600 + i, "urban" if i < 5 else "highway", 100) for i in range(10)],
    "one-clock": [
        DaySpec(4620 + i, "urban" if i < 5 else "highway", 100, "paper-one-clock") for i in range(10)
    ],
    "coverage": _both(4300, 100),
    "verdict": [
        *_both(4500, 8, fault="camera:labels:1"),
        *_both(4520, 8, fault="camera:night:1"),
        *_both(4540, 4, fault="camera:time:0.08"),
        *_both(4550, 4, fault="radar:time:0.08"),
        *_turned(4560),
    ],
    "offsets": [*_both(4700, 10, fault="camera:time:0.04"), *_both(4710, 10, fault="radar:time:0.04")],
    # Rigs in turn, so that whoever stops early has seen all of them; every fifth day at dusk. Seeds 4200 to 4215 are
    # burnt: that a refinement may lower its score was found on them.
    "basin": [
        DaySpec(
            4200 + i,
            ("urban", "highway", "mixed")[i % 3],
            rig=rig,
            fault="camera:dusk:1" if i % 5 == 3 else "",
        )
        for i, rig in enumerate(
            10 * ("paper", "ring16", "demo", "spin128", "pinhole", "rosette", "fisheye", "truck")
        )
        if i >= 16
    ],
    # Eight rigs, a day each, by day and at dusk: exact starts of every size (`basin.py --starts`). Tuning: dev-basin.
    "basin-starts": _a_day_of_each_rig(4400, ("mixed", "highway", "urban"), dusk=2),
    # The same with other drives, worlds and dusk in another order, for a first look at 0.12.0.
    "basin-starts-2": _a_day_of_each_rig(4408, ("highway", "urban", "mixed"), dusk=1),
    "radar-elevation": [
        *_both(4000, 4),
        *_both(4006, 2),
        *_both(4010, 2),
        *_both(4004, 2, rig="ring16"),
        *_both(4008, 2, rig="ring16"),
    ],
    "radar-dirty": [
        DaySpec(5400 + i, ("urban", "highway")[i // 6 % 2], rig=f"{rig}-dirty")
        for i, rig in enumerate(8 * ("paper", "ring16", "demo", "truck", "bumper", "spin128"))
    ],
    # Highways alone, whose convoys leave a scan little that stands still.
    "radar-convoys": [
        DaySpec(5450 + i, "highway", 20, rig=f"{rig}-dirty")
        for i, rig in enumerate(("paper", "ring16", "demo", "truck", "bumper", "spin128"))
    ],
    "dev-dirty": [
        DaySpec(120 + i, ("urban", "highway")[i // 6 % 2], rig=f"{rig}-dirty")
        for i, rig in enumerate(2 * ("paper", "ring16", "demo", "truck", "bumper", "spin128"))
    ],
}


def main() -> None:
    """Generate what is missing, in the order named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=["generate", "adopt", "gather"])
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument(
        "--shard", default="0/1", help="I/N: every N-th day from the I-th, for N commands at once"
    )
    parser.add_argument("--lidar-semantics", default="", help="network that labels the lidar's points")
    parser.add_argument("--out", type=Path, help="folder of the gathered fleet")
    parser.add_argument("--fleet", type=Path)
    parser.add_argument("--lake")
    parser.add_argument("--vehicle")
    parser.add_argument("--day")
    args = parser.parse_args()
    if args.command == "adopt":
        print(adopt_day(args.fleet, args.lake, Partition(args.vehicle, args.day), args.root))
        return
    if args.command == "gather":
        print(gather_days([spec for name in args.sets for spec in SETS[name]], args.root, args.out))
        return
    shard, shards = (int(v) for v in args.shard.split("/"))
    for name in args.sets:
        for spec in SETS[name][shard::shards]:
            began = time.time()
            generate_day(spec, args.root, lidar_semantics=args.lidar_semantics)
            print(f"{time.strftime('%H:%M:%S')} {name} {spec.name} ({time.time() - began:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
