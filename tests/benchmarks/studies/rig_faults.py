"""Study: what a fault of one sensor does to the poses and edges of a rig with thirteen.

    python -m tests.benchmarks.studies.rig_faults --root DAYS --seeds 731 732 733 [--only NAME] [--out FILE]
    python -m tests.benchmarks.studies.rig_faults --root DAYS --nights SEED:SENSOR:DAY ... [--out FILE]

Days of the van are simulated once and kept under `--root`. A case is one fault of one sensor: it is put into the day's
logs (`fault_logs.py`), and a camera that turns at noon is simulated. Which sensor has it goes round with the days. The
whole chain reads these logs; an edge whose rows and prior the fault leaves as they were is solved once a day. Nights
take a sequence of good days, turn a sensor by half a degree from one day on, and ask the audit which sensor moved.

A pose or record is wrong where it is accepted and a direction that it certifies is off by more than its limit. A camera
with a wrong principal point is measured in the image, as its accepted records say they are good for.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import pickle
import resource
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from pipeline.calibrate import base_edges, rig_day
from pipeline.calibrate.records import Inputs
from pipeline.config import FleetConfig, VerifyConfig, load_fleet
from pipeline.errors import SolveError
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.geometry.targets import errors_at_targets
from pipeline.perceive import stage as perceive_stage
from pipeline.perceive.rejections import FrameRejectedError
from pipeline.results import silent
from pipeline.rig.rig import Rig
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, rigs_of, simulate_vehicle_day
from pipeline.simulate.logs.fleet_toml import mixed_fleet_toml
from pipeline.simulate.sensors.rigs import RIGS
from pipeline.store.current import current_poses, current_records, targets_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES, PoseRow
from tests.benchmarks.studies.commits import accept_argument, commit_now, is_accepted
from tests.benchmarks.studies.engine import RESULTS, read_results
from tests.benchmarks.studies.fault_logs import EDITS, rewrite_logs
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.rates import rate
from tests.benchmarks.studies.rig_days import row_of, true_poses
from tests.makers.stages import audit_fleet, calibrate_day, ingest_day, perceive_day

__all__ = ["CASES", "OF_KIND", "REMEMBERED", "Remembered", "is_on_base", "is_wrong", "summary"]

VEHICLE, DATE, FRAMES = "vehicle-1", "2026-03-02", 60
OF_KIND = {
    "camera": ("left", "front", "rear_right", "rear", "right", "rear_left"),
    "lidar": ("grille", "top"),
    "radar": ("corner_fl", "nose", "corner_rr", "corner_fr", "corner_rl"),
}
TURNED_DEG = 0.5  # of nights
NOON = "turned at noon"  # of a camera: simulated, for its pictures change
# What is run once for the same rows and priors.
REMEMBERED = {
    perceive_stage: ("perceive_image", "perceive_sweep", "perceive_scan", "motion_of"),
    base_edges: ("estimate_lidar_base", "estimate_lidar_lidar", "estimate_radar_base"),
    rig_day: ("solve_day",),
}


@dataclass(frozen=True)
class Case:
    """One fault of a sensor of a kind: an edit of the logs and its size."""

    name: str
    kind: str = ""
    edit: str = ""
    amount: float = 0.0


CASES = (
    Case("good"),
    Case("lidar turned at noon by .5 deg", "lidar", "lidar yaw at noon", 0.5),
    Case("radar turned at noon by 1 deg", "radar", "radar yaw at noon", 1.0),
    Case(f"camera {NOON} by .5 deg", "camera", NOON, 0.5),
    *(Case(f"{k} turned before the day by .5 deg", k, f"{k} prior {a}", 0.5)
      for k, a in (("camera", "pitch"), ("lidar", "yaw"), ("radar", "yaw"))),
    *(Case(f"{k} late by .1 s", k, f"{k} stamps", 0.1) for k in OF_KIND),
    Case("focal length 1 %", "camera", "focal", 0.01),
    Case("principal point 10 px right", "camera", "centre right", 10.0),
    Case("principal point 10 px down", "camera", "centre down", 10.0),
    *(Case(f"prior of {k} 3 deg off", k, f"{k} prior {a}", 3.0)
      for k, a in (("camera", "pitch"), ("lidar", "yaw"), ("radar", "yaw"))),
    *(Case(f"prior of {k} .3 m off", k, "lidar prior x", 0.3) for k in OF_KIND),
    *(Case(f"{k} silent", k, f"{k} silent") for k in OF_KIND),
    *(Case(f"{k} late by .3 s", k, f"{k} stamps", 0.3) for k in OF_KIND),
    *(Case(f"{k} silent from noon", k, f"{k} silent", 0.5) for k in OF_KIND),
)  # fmt: skip


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--nights", nargs="*", default=[], metavar="SEED:SENSOR:DAY")
    parser.add_argument("--only", nargs="*", default=[], help="cases whose name holds this")
    parser.add_argument("--out", type=Path, default=RESULTS / "rig_faults.jsonl")
    accept_argument(parser)
    args = parser.parse_args()
    now = commit_now()
    done = {
        (r["seed"], r["case"], r["sensor"])
        for r in read_results(args.out)
        if is_accepted(r["commit"], now, args.accept_commits)
    }
    for room, names in REMEMBERED.items():
        for name in names:
            Remembered(room, name)
    for case, sensor, seed in _in_turn(args.seeds, args.only):
        if (seed, case.name, sensor) not in done:
            _write(args.out, {"seed": seed, "case": case.name, "sensor": sensor, "commit": now},
                   partial(run_case, case, sensor, seed, args.root))  # fmt: skip
    for asked in args.nights:
        seed, sensor, day = asked.split(":")
        if (int(seed), "night", sensor) not in done:
            _write(args.out, {"seed": int(seed), "case": "night", "sensor": sensor, "commit": now},
                   partial(run_nights, args.root, int(seed), sensor, int(day)))  # fmt: skip
    lines = [r for r in read_results(args.out) if is_accepted(r["commit"], now, args.accept_commits)]
    text = f"{look('rig_faults', [{**r, 'day': {'seed': r['seed']}} for r in lines])}\n\n{summary(lines)}\n"
    args.out.with_suffix(".md").write_text(text)
    print(text)


def _in_turn(seeds: Sequence[int], only: Sequence[str]) -> Iterator[tuple[Case, str, int]]:
    """Days without a fault, then every case on one day, on the next one and so on, each of its kind's next sensor."""
    cases = [c for c in CASES if not only or any(word in c.name for word in only)]
    yield from ((case, "", seed) for case in cases for seed in seeds if not case.kind)
    for turn in range(len(seeds)):
        for number, case in enumerate(cases):
            if case.kind:
                sensor = OF_KIND[case.kind][(number + turn) % len(OF_KIND[case.kind])]
                yield case, sensor, seeds[(number + turn) % len(seeds)]


def _write(out: Path, about: dict[str, Any], run: Callable[[], dict[str, Any]]) -> None:
    began = time.process_time()
    line = about | {"date": time.strftime("%Y-%m-%d")} | run()
    line["cpu_s"] = round(time.process_time() - began, 1)
    with out.open("a") as file:
        file.write(json.dumps(line) + "\n")
    wrong = [n for part in ("poses", "edges") for n, r in line.get(part, {}).items() if r["wrong"]]
    print(
        about["seed"],
        about["case"],
        about["sensor"],
        "wrong:",
        wrong,
        line["cpu_s"],
        line.get("named"),
        flush=True,
    )


class Remembered:
    """A function that is run once for the same arguments: most of a day is as it is without the fault."""

    kept: ClassVar[dict[bytes, tuple[Any, list[Any]]]] = {}

    def __init__(self, room: ModuleType, name: str) -> None:
        self.name, self.run = name, getattr(room, name)
        setattr(room, name, self)

    def __call__(self, *args: Any, **named: Any) -> Any:
        shown = [_without_place(a) for a in (*args, *(named[n] for n in sorted(named)))]
        key = hashlib.sha256(pickle.dumps((self.name, sorted(named), shown))).digest()
        generators = [a.bit_generator for a in args if isinstance(a, np.random.Generator)]
        if key not in self.kept:
            try:
                found = self.run(*args, **named)
            except (SolveError, FrameRejectedError) as err:
                found = err
            self.kept[key] = found, [g.state for g in generators]
        found, states = self.kept[key]
        for generator, state in zip(generators, states, strict=True):
            generator.state = state
        if isinstance(found, Exception):
            raise found
        return found


def _without_place(argument: Any) -> Any:
    """An argument less where its day lies: a fleet is that of its rig, and records name the work they come of."""
    if isinstance(argument, Inputs):
        return replace(argument, work_key="", inputs=[])
    return "fleet" if isinstance(argument, FleetConfig) else argument


def run_case(case: Case, sensor: str, seed: int, root: Path) -> dict[str, Any]:
    """Every pose and edge of the day with the fault, beside the truth."""
    turned = f"0:{sensor}:yaw:{case.amount}@0.5" if case.edit == NOON else ""
    folder = _folder(root, seed, 1, turned)
    with tempfile.TemporaryDirectory() as scratch:
        lake, fleet = Lake.at(Path(scratch) / "lake"), load_fleet(folder / "fleet.toml")
        truth = json.loads((folder / "truth" / VEHICLE / f"{DATE}.json").read_text())
        base = true_poses(truth)
        if EDITS.get(case.edit) and case.edit.endswith("noon"):
            base[sensor] = base[sensor] @ _turn(np.radians(case.amount) * np.eye(3)[2])
        _day(folder, DATE, case.edit, case.amount, sensor, fleet, lake, Path(scratch))
        return measured(lake, DATE, fleet, _seen(case, sensor, base, truth))


def _day(folder: Path, day: str, edit: str, amount: float, sensor: str, fleet: FleetConfig, lake: Lake,
         scratch: Path) -> None:  # fmt: skip
    """Logs of a day, with an edit, to records."""
    logs = sorted((folder / "logs" / VEHICLE / day).iterdir())
    if edit in EDITS:
        topics = _topics(fleet.rig_of(VEHICLE), sensor)
        edited = rewrite_logs(logs, scratch / f"logs-{day}", topics, EDITS[edit], amount, sensor)
        logs = [path.rename(path.with_name(log.name)) for log, path in zip(logs, edited, strict=True)]
    partition = Partition(VEHICLE, day)
    outcome = ingest_day(logs, partition, fleet, lake)
    if outcome.status != "refused":
        outcome = perceive_day(partition, fleet, lake)
    calibrate_day(partition, fleet, lake, **({"given": outcome} if outcome.status == "refused" else {}))
    shutil.rmtree(scratch / f"logs-{day}", ignore_errors=True)


def _folder(root: Path, seed: int, days: int, fault: str = "", first: int = 0) -> Path:
    """Logs, truth and fleet.toml of a simulated sequence, made unless they are there.

    With `fault` (as simulate has it, less the vehicle) a sequence from its day on: those before are as without it.
    """
    folder = root / f"van_{days}_{seed}{fault and '_' + fault.replace(':', '-')}"
    if not (folder / "done").exists():
        shutil.rmtree(folder, ignore_errors=True)
        faults = parse_faults(f"{VEHICLE}:{fault}" if fault else "", day_names(DATE, days), RIGS["van"])
        spec = FleetSpec(1, days, DATE, FRAMES, rig="van", faults=faults, seed=seed)
        folder.mkdir(parents=True)
        (folder / "fleet.toml").write_text(mixed_fleet_toml("synthetic", rigs_of(spec)))
        for day in range(first, days):
            simulate_vehicle_day(spec, 0, day, folder, silent)
        (folder / "done").touch()
    return folder


def _topics(rig: Rig, sensor: str) -> dict[str, str]:
    """Topic of each role of `fault_logs`."""
    if sensor in rig.cameras:
        own = {"image": "image/compressed", "info": "camera_info"}
        found = {role: f"/camera/{sensor}/{name}" for role, name in own.items()}
        found |= {role: f"/perception/{sensor}/{role}" for role in ("labels", "detections")}
    elif sensor in rig.lidars:
        found = {"lidar": rig.lidars[sensor].points}
    else:
        found = {"radar": rig.radars[sensor].points}
    return found | {"tf": "/tf_static"}


def _turn(rotation: np.ndarray) -> np.ndarray:
    return from_rotation_translation(exp_so3(rotation), np.zeros(3))


def _seen(
    case: Case, sensor: str, base: Mapping[str, np.ndarray], truth: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """Poses with a camera where its wrong principal point puts things."""
    px = {"centre right": (case.amount, 0.0), "centre down": (0.0, case.amount)}.get(case.edit)
    if px is None:
        return dict(base)
    K = truth["cameras"][sensor]["K"]
    return {**base, sensor: base[sensor] @ inverse(_turn(np.array([px[1] / K[1][1], -px[0] / K[0][0], 0.0])))}


def measured(lake: Lake, day: str, fleet: FleetConfig, base: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Poses by sensor and records by edge, each beside the truth."""
    found = current_poses(read_records(lake, POSES, PoseRow, vehicle=VEHICLE, day=day))
    poses = {p.sensor: _of_pose(p, base, fleet.verify) for p in found if p.sensor != p.reference}
    records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=VEHICLE, day=day))
    edges = {f"{r.parent_frame}-{r.child_frame}": _of_edge(r, base, fleet.verify) for r in records}
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"poses": poses, "edges": edges, "memory_gb": round(memory_gb, 2)}


def _of_pose(pose: PoseRow, base: Mapping[str, np.ndarray], verify: VerifyConfig) -> dict[str, Any]:
    row = row_of(pose, base) | {"faults": pose.faults}
    T, covariance = transform_of(pose), pose.covariance
    if T is not None and covariance is not None:
        true = inverse(base[pose.reference]) @ base[pose.sensor]
        row["off"] = _short(change_between(true, T))
        row["sigma"] = _short(np.sqrt(np.diag(change_covariance(T, covariance))))
    return _judged(row, pose.kind, verify)


def _of_edge(
    record: CalibrationRecord, base: Mapping[str, np.ndarray], verify: VerifyConfig
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "kind": record.pair, "status": record.status, "reason": record.reason, "faults": record.faults,
        "determined": record.determined, "used": record.used,
    }  # fmt: skip
    if record.innovation_sigmas is not None:
        row["innovation_sigmas"] = round(record.innovation_sigmas, 2)
    T, a, b = transform_of(record), record.azimuth_sigma_rad, record.elevation_sigma_rad
    if T is not None and a is not None and b is not None:
        true = inverse(base[record.parent_frame]) @ base[record.child_frame]
        off = np.degrees(errors_at_targets(record.pair, T, true, targets_of(record))[:2])
        row |= dict(zip(("az_deg", "el_deg"), _short(off), strict=True))
        row |= dict(zip(("az_sigma_deg", "el_sigma_deg"), _short(np.degrees([a, b])), strict=True))
    return _judged(row, record.pair, verify)


def _judged(row: dict[str, Any], kind: str, verify: VerifyConfig) -> dict[str, Any]:
    camera = verify.camera_lidar_limit_deg
    radar = (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
    limits = {**row, "limit_deg": list(radar if "radar" in kind else (camera, camera))}
    return {**limits, "wrong": is_wrong(limits)}


def is_wrong(row: Mapping[str, Any]) -> bool:
    """Accepted, and a direction that it certifies lies beyond its limit."""
    names = (("azimuth", "az_deg"), ("elevation", "el_deg"))
    beyond = [n for (n, key), limit in zip(names, row["limit_deg"], strict=True) if row.get(key, 0.0) > limit]
    return row["status"] == "accepted" and bool(set(beyond) & set(row.get("determined") or ()))


def _short(values: Iterable[float]) -> list[float]:
    return [float(f"{v:.4g}") for v in values]


def run_nights(root: Path, seed: int, sensor: str, first: int) -> dict[str, Any]:
    """Which sensor the audit names after a sequence whose sensor is turned from a day on, the first day being 0."""
    folder, days, kept = _folder(root, seed, 5), day_names(DATE, 5), root / f"lake_5_{seed}"
    fleet = load_fleet(folder / "fleet.toml")
    kind = next(k for k, names in OF_KIND.items() if sensor in names)
    with tempfile.TemporaryDirectory() as scratch:
        if not (kept / "done").exists():  # as it is without a fault
            for day in days:
                _day(folder, day, "", 0.0, "", fleet, Lake.at(kept), Path(scratch))
            (kept / "done").touch()
        lake = Path(scratch) / "lake"
        shutil.copytree(kept, lake)
        if kind == "camera":
            folder = _folder(root, seed, 5, f"{first}:{sensor}:yaw:{TURNED_DEG}", first)
        for day in days[first:]:  # the edit "backwards" turns a sensor all day
            _day(folder, day, f"{kind} backwards", TURNED_DEG, sensor, fleet, Lake.at(lake), Path(scratch))
        return named_by_audit(Lake.at(lake), fleet, sensor, days[first])


def named_by_audit(lake: Lake, fleet: FleetConfig, sensor: str, day: str) -> dict[str, Any]:
    """What the audit says of the window: sensors named, days of alarms."""
    findings = audit_fleet(lake, fleet)
    alarms = [f for f in findings if f.status == "RED"]
    edges = sorted({f"{f.parent_frame}-{f.child_frame}" for f in alarms})
    days = Counter(f.start_day for f in alarms)
    told = {
        "named": sorted({f.vehicle_sensor for f in findings if f.vehicle_sensor}),
        "red": edges,
        "days": dict(days),
    }
    explained = {f"{f.moved_sensor}": f.moved_probability for f in findings if f.moved_sensor}
    status = sorted({str(f.vehicle_status) for f in findings})
    since = sorted({str(f.vehicle_since) for f in findings})
    reason = next((f.vehicle_reason for f in findings if f.vehicle_reason), "")
    return {
        "turned": sensor,
        "from": day,
        "status": status,
        "since": since,
        "moved": explained,
        "reason": reason,
    } | told


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """Tables: fault by fault, coverage by kind, lidars on the vehicle frame, nights."""
    days = [r for r in lines if r["case"] != "night"]
    nights = [r for r in lines if r["case"] == "night"]
    parts = (
        [_counted(days), _by_fault(days), _coverage(days), _by_edges(days), _on_base(days)] if days else []
    )
    return "\n\n".join([*parts, *([_of_nights(nights)] if nights else [])])


def _rows(lines: Iterable[Mapping[str, Any]], part: str, status: str = "accepted") -> list[Mapping[str, Any]]:
    return [row for r in lines for row in r[part].values() if row["status"] == status]


def _counted(days: Sequence[Mapping[str, Any]]) -> str:
    seeds, poses, edges = {r["seed"] for r in days}, _rows(days, "poses"), _rows(days, "edges")
    sensor_days = sum(len(r["poses"]) for r in days)
    wrong = [(r, name) for r in days for name, row in r["poses"].items() if row["wrong"]]
    hit = sum(name == r["sensor"] for r, name in wrong)
    return (
        f"{sensor_days} sensor-days of {len(days)} van-days, made of {len(seeds)} distinct days (60 moments each). "
        f"Poses accepted {len(poses)}, of them wrong **{rate(len(wrong), len(poses))}** ({hit} of the sensor with the "
        f"fault); edges accepted {len(edges)}, wrong {rate(sum(e['wrong'] for e in edges), len(edges))}."
    )


def _by_fault(days: Sequence[Mapping[str, Any]]) -> str:
    """Of each case: poses of the sensor with the fault, all poses, edges."""
    heads = (
        "fault",
        "days",
        "its pose: status (named)",
        "poses accepted",
        "wrong",
        "edges accepted",
        "wrong",
    )
    found = [_line(heads), _line(["---"] * len(heads))]
    for case in dict.fromkeys(r["case"] for r in days):
        own = [r for r in days if r["case"] == case]
        hit = [
            r["poses"].get(r["sensor"], {"status": "the reference", "faults": []}) for r in own if r["sensor"]
        ]
        told = [f"{p['status']}{' (' + ', '.join(p['faults']) + ')' if p.get('faults') else ''}" for p in hit]
        counts = [n for part in ("poses", "edges")
                  for n in (len(_rows(own, part)), sum(row["wrong"] for row in _rows(own, part)))]  # fmt: skip
        found.append(
            _line([case, len(own), "; ".join(f"{n} {t}" for t, n in Counter(told).items()), *counts])
        )
    return "\n".join(found)


def _coverage(days: Sequence[Mapping[str, Any]]) -> str:
    """Errors in sigmas, by kind, of accepted poses of days without a fault and of sensors without one."""
    heads = ("kind", "poses", "azimuth in 1, 3 sigmas", "elevation in 1, 3 sigmas", "chi-squared per unknown")
    found = [_line(heads), _line(["---"] * len(heads))]
    fair = [
        row
        for r in days
        for name, row in r["poses"].items()
        if name != r["sensor"] and row["status"] == "accepted"
    ]
    for kind in dict.fromkeys(row["kind"] for row in fair):
        own = [row for row in fair if row["kind"] == kind]
        cells = []
        for angle in ("az", "el"):
            z = np.array([row[f"{angle}_deg"] / row[f"{angle}_sigma_deg"] for row in own])
            cells.append(f"{100 * np.mean(z <= 1):.0f} %, {100 * np.mean(z <= 3):.0f} %")
        found.append(_line([kind, len(own), *cells, f"{np.mean([row['chi2_per_dof'] for row in own]):.2f}"]))
    return "\n".join(found)


def _on_base(days: Sequence[Mapping[str, Any]]) -> str:
    """The reference lidar on the vehicle frame: largest errors of good days and of faults elsewhere."""
    own = [
        r["poses"]["base"]
        for r in days
        if r["poses"]["base"]["status"] == "accepted" and r["sensor"] != "top"
    ]
    off = np.abs([row["off"] for row in own])
    good = [is_on_base(v) for v in off]
    roll, pitch, yaw = np.degrees(off[:, :3]).max(axis=0)
    return (
        f"Reference lidar on the vehicle frame: {rate(sum(good), len(good))} of accepted poses within roll, pitch, yaw "
        f".1 deg and height 2 cm; largest {roll:.3f}, {pitch:.3f}, {yaw:.3f} deg, {100 * off[:, 5].max():.1f} cm."
    )


def is_on_base(off: Sequence[float]) -> bool:
    """Whether roll, pitch and yaw [rad] are within .1 deg and the height [m] within 2 cm."""
    return bool(np.degrees(np.abs(off[:3])).max() <= 0.1 and abs(off[5]) <= 0.02)


def _by_edges(days: Sequence[Mapping[str, Any]]) -> str:
    """Sensors without a fault: what their pose's sigma is beside that of its surest edge, by how many it rests on."""
    heads = (
        "poses that rest on",
        "number",
        "sigma over its surest edge's: median (25 to 75 %)",
        "in 1, 3 sigmas",
    )
    found = [_line(heads), _line(["---"] * len(heads))]
    shares: dict[str, list[tuple[float, float]]] = {}
    for r in days:
        for name, row in r["poses"].items():
            own = [e for key, e in r["edges"].items() if name in key.split("-") and "az_sigma_deg" in e]
            if name in (r["sensor"], "base") or row["status"] != "accepted" or not own:
                continue
            many = {1: "one edge", 2: "two"}.get(len(row["edges"]), "three or more")
            surest = min(e["az_sigma_deg"] for e in own)
            z = row["az_deg"] / row["az_sigma_deg"]
            shares.setdefault(many, []).append((row["az_sigma_deg"] / surest, z))
    for many, pairs in sorted(shares.items()):
        ratio, z = np.array(pairs).T
        low, middle, high = np.quantile(ratio, [0.25, 0.5, 0.75])
        inside = f"{100 * np.mean(z <= 1):.0f} %, {100 * np.mean(z <= 3):.0f} %"
        found.append(_line([many, len(z), f"{middle:.2f} ({low:.2f} to {high:.2f})", inside]))
    return "\n".join(found)


def _of_nights(nights: Sequence[Mapping[str, Any]]) -> str:
    heads = ("sequence", "turned", "from", "named", "since", "red edges")
    found = [_line(heads), _line(["---"] * len(heads))]
    for r in nights:
        cells = [r["seed"], r["turned"], r["from"], ", ".join(r["named"]) or "none", ", ".join(r["since"])]
        found.append(_line([*cells, ", ".join(r["red"])]))
    return "\n".join(found)


def _line(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(c) for c in cells) + " |"


if __name__ == "__main__":
    main()
