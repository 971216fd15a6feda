"""Study: what everyday faults do to records. Every fault is put into logs, and the whole chain reads them.

    python tests/benchmarks/studies/faults.py --root DAYS --workers 2 [--tuning] [--real FOLDER]

Days of three rigs are simulated once and kept with their logs under `--root`. `--real` adds the real vehicle-day, as
far as the messages of its logs are CDR; its given calibration, good to 0.25 deg, stands in for the truth and widens
what counts as right. Each run copies a day's logs with one edit of `fault_logs`, ingests, perceives and calibrates
them, and measures every record against the truth as the fault leaves it.

A record is wrong where it is accepted and a direction that it certifies is off by more than three of its sigmas or by
more than its limit. A record of a day with a wrong principal point is measured in the image, and in the mounting too
where it certifies that. A fault is named where a record that the same day without the fault has accepted is held or
refused and states it in `faults`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import FleetConfig, load_fleet
from pipeline.geometry.cameras import camera_of
from pipeline.geometry.changes import change_between
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_fleet
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import observations_of
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.commits import accept_argument, commit_now, is_accepted
from tests.benchmarks.studies.engine import RESULTS, read_results
from tests.benchmarks.studies.fault_logs import EDITS, rewrite_logs
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.metrics import transform_of
from tests.benchmarks.studies.rates import rate
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

VEHICLE, DATE, FRAMES = "vehicle-1", "2026-03-02", 60
RIGS = ("demo", "paper", "truck")
REAL_FLEET = Path("tests/end_to_end/astyx.toml")
# The real car's given calibration is good to these [deg].
REAL_SIGMA_DEG = {"camera_lidar": 0.12, "camera_radar": 0.2, "lidar_radar": 0.2}
SIGMAS = 3.0
TUNING, TESTED = range(100, 106), range(5200, 5212)
GOOD = range(5300, 5340)  # more days without a fault: how many are stopped all the same


@dataclass(frozen=True)
class Case:
    """One fault: an edit of the logs, or `simulated` as `boresight simulate --faults` has it."""

    name: str
    amount: float
    named: tuple[
        str, ...
    ]  # faults of schemas.faults, any of which names it rightly; none: nothing need be named
    frame: str = ""  # sensor that an edit of tf_static is about
    simulated: str = ""


def _cases() -> tuple[Case, ...]:
    """Sizes from harmless to absurd."""
    labels, info, moved, prior = ("labels_offset",), ("camera_info",), ("moved_in_day",), ("prior",)
    found = [Case("good", 0.0, ())]
    found += [Case("labels right", px, labels) for px in (1, 2, 3, -3)]
    found += [Case("labels down", px, labels) for px in (1, 2, -3)]
    found += [Case("labels diagonal", 3, labels), Case("labels scaled", 1.01, labels)]
    found += [
        Case("labels scaled", 1.03, labels),
        Case("labels padded", 6, labels),
        Case("labels late", 1, labels),
    ]
    found += [Case("focal", share, info) for share in (0.01, 0.03, -0.05)]
    found += [Case("centre right", px, info) for px in (4, 10, -20)]
    found += [Case("centre down", px, info) for px in (4, -10)]
    found += [Case("k1", 0.1, info), Case("camera stuck", 0.0, ("stuck_sensor",))]
    found += [Case("camera stamps", s, ("time_offset",)) for s in (0.03, 0.5)]
    found += [Case("camera silent", share, ("silent_sensor",)) for share in (0.0, 0.5)]
    found += [Case("labels silent", 0.0, ("silent_sensor",))]
    found += [Case("lidar scaled", factor, ("unit", "prior")) for factor in (1.002, 1.02, 1000.0)]
    found += [
        Case("lidar mirrored", 0.0, ("orientation", "prior")),
        Case("lidar stuck", 0.0, ("stuck_sensor",)),
    ]
    found += [Case("lidar stamps", 0.1, ("time_offset",)), Case("lidar silent", 0.0, ("silent_sensor",))]
    found += [Case("lidar yaw at noon", deg, moved) for deg in (0.1, 0.3, 0.5, 2.0)]
    found += [Case("lidar pitch late", deg, moved) for deg in (0.3, 0.5)]
    found += [Case("lidar roll at noon", 1.0, moved)]
    found += [Case("lidar backwards", 180.0, ("orientation", "prior"))]
    found += [Case("lidar prior x", 0.3, prior, "lidar"), Case("lidar prior z", 0.1, prior, "lidar")]
    found += [Case("lidar prior z", 0.3, prior, "lidar"), Case("lidar prior yaw", 12.0, prior, "lidar")]
    found += [
        Case("radar scaled", 1.02, ("unit", "prior")),
        Case("radar mirrored", 0.0, ("orientation", "prior")),
    ]
    found += [Case("radar stuck", share, ("stuck_sensor",)) for share in (0.0, 0.5)]
    found += [Case("radar stamps", s, ("time_offset",)) for s in (0.04, 0.5)]
    found += [Case("radar silent", share, ("silent_sensor",)) for share in (0.0, 0.5)]
    found += [Case("radar empty", 0.0, ("silent_sensor",))]
    found += [Case("radar yaw at noon", deg, moved) for deg in (0.3, 1.0, 3.0)]
    found += [Case("radar backwards", 180.0, ("orientation", "prior"))]
    found += [Case("radar prior x", x_m, prior, "radar") for x_m in (0.03, 0.5)]
    found += [Case("radar prior yaw", 12.0, prior, "radar"), Case("camera prior pitch", 3.0, prior, "camera")]
    found += [Case("doppler", factor, ("doppler",)) for factor in (-1.0, 1.1, 3.6)]
    found += [Case("odometry speed", factor, ("odometry",)) for factor in (1.03, 1.2, 2.0)]
    found += [Case("odometry reversed", 0.0, ("odometry",)), Case("odometry turn rate", 0.0, ("odometry",))]
    found += [Case("odometry late", s, ("odometry",)) for s in (0.05, 0.3)]
    found += [Case("odometry silent", 0.0, ())]
    found += [Case("camera turned", deg, moved, "", f"camera:yaw:{deg}@0.5") for deg in (0.3, 1.0)]
    return tuple(found)


CASES = _cases()


@dataclass(frozen=True)
class Run:
    """A case on a day; seed 0 is the real day."""

    case: str
    amount: float
    rig: str
    seed: int

    @property
    def key(self) -> str:
        """What tells this run from all others."""
        return json.dumps(asdict(self), sort_keys=True)


def runs_of(seeds: Sequence[int], *, real: bool, good: Sequence[int] = ()) -> list[Run]:
    """Every case on one day of each rig, the days in turn; every day, and those of `good`, once without a fault."""
    days = [(RIGS[i % len(RIGS)], seed) for i, seed in enumerate(seeds)]
    more = [(RIGS[i % len(RIGS)], seed) for i, seed in enumerate(good)]
    found = [Run("good", 0.0, rig, seed) for rig, seed in days + more]
    for number, case in enumerate(CASES[1:]):
        for k, rig in enumerate(RIGS):
            of_rig = [seed for r, seed in days if r == rig]
            found.append(Run(case.name, case.amount, rig, of_rig[(number + k) % len(of_rig)]))
    if real:
        found += [
            Run(c.name, c.amount, "real", 0) for c in CASES if not (c.simulated or "odometry" in c.name)
        ]
    return found


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="days with their logs, made where missing")
    parser.add_argument("--real", type=Path, help="folder of the real vehicle-day's logs")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--tuning", action="store_true", help="tuning seeds in place of test seeds")
    parser.add_argument("--out", type=Path, default=RESULTS / "faults.jsonl")
    accept_argument(parser)
    args = parser.parse_args()
    seeds, good = (TUNING, ()) if args.tuning else (TESTED, GOOD)
    runs = [r for r in runs_of(seeds, real=args.real is not None, good=good) if args.only in r.case]
    now = commit_now()
    done = _results(runs, args, now)
    todo = [r for r in runs if r.key not in done][: args.limit]
    print(f"{len(runs)} runs, {len(todo)} to do", flush=True)
    with (
        ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool,
        args.out.open("a") as out,
    ):
        days = {(r.rig, r.seed) for r in todo if r.seed}
        list(
            pool.map(_make_day, *zip(*[(args.root, *day) for day in sorted(days)], strict=True))
        ) if days else None
        jobs = {pool.submit(run_case, run, args.root, args.real): run for run in todo}
        for number, job in enumerate(as_completed(jobs), 1):
            run = jobs[job]
            if (err := job.exception()) is not None:
                print(f"{number}/{len(todo)} FAILED {run}: {err!r}", flush=True)
                continue
            about = {"day": {"seed": run.seed}, "commit": now, "date": time.strftime("%Y-%m-%d")}
            line = {**asdict(run), **about, **job.result()}
            out.write(json.dumps(line) + "\n")
            out.flush()
            print(f"{number}/{len(todo)} {_line(line)}", flush=True)
    results = list(_results(runs, args, now).values())
    text = f"{look('faults', results)}\n\n{summary(results)}\n"
    args.out.with_suffix(".md").write_text(text)
    print(text)


def _results(runs: Sequence[Run], args: argparse.Namespace, now: str) -> dict[str, dict[str, Any]]:
    wanted = {r.key for r in runs}
    names = Run.__dataclass_fields__
    lines = {
        Run(**{n: line[n] for n in names}).key: line
        for line in read_results(args.out)
        if is_accepted(line["commit"], now, args.accept_commits)
    }
    return {key: line for key, line in lines.items() if key in wanted}


def _folder(root: Path, rig: str, seed: int, fault: str = "") -> Path:
    return root / f"{rig}_{FRAMES}_{seed}{'_' + fault.replace(':', '-') if fault else ''}"


def _make_day(root: Path, rig: str, seed: int, fault: str = "") -> Path:
    """Logs, truth and fleet.toml of a simulated day, made unless they are there."""
    folder = _folder(root, rig, seed, fault)
    if (folder / "done").exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    faults = parse_faults(f"{VEHICLE}:{DATE}:{fault}" if fault else "", day_names(DATE, 1))
    world = ("urban", "mixed", "highway")[seed % 3]
    simulate_fleet(
        FleetSpec(
            vehicles=1, days=1, first_day=DATE, frames=FRAMES, rig=rig, environments=world, faults=faults, seed=seed
        ),
        folder,
    )  # fmt: skip
    (folder / "done").touch()
    return folder


def run_case(run: Run, root: Path, real: Path | None) -> dict[str, Any]:
    """Records of the day with the fault, against the truth."""
    case = next(c for c in CASES if (c.name, c.amount) == (run.case, run.amount))
    began = time.process_time()
    if run.seed:
        folder = _make_day(root, run.rig, run.seed, case.simulated)
        truth = json.loads(next((folder / "truth" / VEHICLE).glob("*.json")).read_text())
        logs, fleet, vehicle = (
            sorted((folder / "logs" / VEHICLE / DATE).iterdir()),
            load_fleet(folder / "fleet.toml"),
            VEHICLE,
        )
    else:
        assert real is not None
        given = json.loads((real / "given_calibration.json").read_text())["astyx-1_2019-01-14_00"]
        T_radar = {sensor: np.array(given[f"T_radar_{sensor}"]) for sensor in ("camera", "lidar")}
        truth = {
            "T_camera_lidar": inverse(T_radar["camera"]) @ T_radar["lidar"],
            "T_lidar_radar": inverse(T_radar["lidar"]),
        }
        logs, fleet, vehicle = _real_logs(real), load_fleet(REAL_FLEET), "astyx-1"
    with tempfile.TemporaryDirectory() as scratch:
        edit = EDITS.get(case.name)
        if edit is not None:
            frame = {"lidar": "lidar_top", "radar": "radar_front", "camera": "camera_front_optical"}.get(
                case.frame, ""
            )
            logs = rewrite_logs(logs, Path(scratch) / "logs", _topics(fleet), edit, case.amount, frame)
        lake, partition = (
            Lake.at(Path(scratch) / "lake"),
            Partition(vehicle, DATE if run.seed else "2019-01-14"),
        )
        outcome = ingest_day(logs, partition, fleet, lake)
        if outcome.status != "refused":
            outcome = perceive_day(partition, fleet, lake)
        given_outcome = {"given": outcome} if outcome.status == "refused" else {}
        calibrate_day(partition, fleet, lake, seed=run.seed, **given_outcome)
        records = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle)
        rows = [] if given_outcome else list(observations_of(lake, partition))
    T_true = _truth(case, truth)
    pairs = {r.pair: _measured(r, case, T_true, truth, rows) for r in records}
    return {"pairs": pairs, "cpu_s": round(time.process_time() - began, 1)}


def _topics(fleet: FleetConfig) -> dict[str, str]:
    rig = next(iter(fleet.rigs.values()))
    found = {
        "image": rig.camera.image,
        "info": rig.camera.info,
        "lidar": rig.lidar.points,
        "radar": rig.radar.points,
    }
    found |= {
        "labels": rig.camera.semantics.labels,
        "detections": rig.camera.semantics.detections,
        "tf": "/tf_static",
    }
    return found | ({"odometry": rig.ego.odometry} if rig.ego and rig.ego.odometry else {})


def _real_logs(real: Path) -> list[Path]:
    return [real / f"astyx-1_2019-01-14_{name}" for name in ("00.mcap", "01.mcap", "03")]


def _truth(case: Case, truth: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """True transforms at the end of the day, as the fault leaves them; a radar's are those of its detections."""
    cl, lr = (np.array(truth[f"T_{pair}"], np.float64) for pair in ("camera_lidar", "lidar_radar"))
    bias_rad = truth.get("radar_elevation_bias_rad")
    if isinstance(bias_rad, float):
        lr = lr @ _turn([0.0, bias_rad, 0.0])
    for sensor in ("lidar", "radar"):
        axis = {"yaw at noon": 2, "pitch late": 1, "roll at noon": 0, "backwards": 2}.get(
            case.name.removeprefix(f"{sensor} ")
        )
        if not case.name.startswith(sensor) or axis is None:
            continue
        turn = _turn(np.radians(case.amount) * np.eye(3)[axis])
        cl, lr = (cl @ turn, inverse(turn) @ lr) if sensor == "lidar" else (cl, lr @ turn)
    return {"camera_lidar": cl, "lidar_radar": lr, "camera_radar": cl @ lr}


def _turn(rotation: Sequence[float] | np.ndarray) -> np.ndarray:
    return from_rotation_translation(exp_so3(np.asarray(rotation, np.float64)), np.zeros(3))


def _offset_s(pair: str, case: Case, truth: Mapping[str, Any]) -> float | None:
    """True dt of a pair, with what the fault adds to stamps."""
    offset = truth.get(f"dt_{pair}_s")
    if offset is None:
        return None
    parent, child = pair.split("_")
    late = {"camera stamps": "camera", "lidar stamps": "lidar", "radar stamps": "radar"}.get(case.name)
    return float(offset) + case.amount * ((late == parent) - (late == child))


def _measured(
    record: CalibrationRecord,
    case: Case,
    T_true: Mapping[str, np.ndarray],
    truth: Mapping[str, Any],
    rows: Sequence[Observation],
) -> dict[str, Any]:
    """Errors at the targets with their sigmas, and what the record claims."""
    out: dict[str, Any] = {
        "status": record.status,
        "reason": record.reason,
        "faults": record.faults,
        "determined": record.determined,
    }
    T = transform_of(record)
    if T is None or record.azimuth_sigma_rad is None or not rows:
        return out
    pair, T_mounted = record.pair, T_true[record.pair]
    T_image = _in_image(case, T_mounted, rows) if pair.startswith("camera") else T_mounted
    out["limit_deg"] = _deg([record.limit_rad, record.diagnostics["elevation_limit_rad"]])
    out["sigma_deg"] = _deg([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    out["error_deg"] = _deg(_direction_errors(record, T, T_image))
    out["mounting_error_deg"] = _deg(_direction_errors(record, T, T_mounted))
    out["mounting_determined"] = record.mounting_determined
    out["error"] = [float(f"{v:.4g}") for v in change_between(T_mounted, T)]
    offset_s = _offset_s(pair, case, truth)
    if record.time_offset_s is not None and offset_s is not None:
        out["dt_error_s"] = round(record.time_offset_s - offset_s, 5)
        out["dt_sigma_s"] = round(record.time_offset_sigma_s or 0.0, 5)
    return out


def _direction_errors(record: CalibrationRecord, T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation error at the targets, root mean square [rad]."""
    from pipeline.geometry.targets import errors_at_targets
    from pipeline.store.current import targets_of

    azimuth, elevation, _ = errors_at_targets(record.pair, T, T_true, targets_of(record))
    return float(azimuth), float(elevation)


def _in_image(case: Case, T: np.ndarray, rows: Sequence[Observation]) -> np.ndarray:
    """The pose that puts points where they are seen, with the principal point of the wrong CameraInfo."""
    px = {"centre right": (case.amount, 0.0), "centre down": (0.0, case.amount)}.get(case.name)
    if px is None:
        return T
    K = camera_of(rows[0]).K
    return _turn([px[1] / K[1, 1], -px[0] / K[0, 0], 0.0]) @ T


def _deg(values: Iterable[float | None]) -> list[float | None]:
    return [None if v is None else round(float(np.degrees(v)), 4) for v in values]


def is_right(pair: str, found: Mapping[str, Any], rig: str, *, every: bool = False) -> bool:
    """Whether the directions that a record certifies (or both) are right within their limit and three sigmas."""
    if "error_deg" not in found:
        return False
    names = ("azimuth", "elevation")
    asked = [k for k, name in enumerate(names) if every or name in found["determined"]]
    reference = REAL_SIGMA_DEG[pair] if rig == "real" else 0.0
    for k in asked:
        error, sigma = found["error_deg"][k], float(np.hypot(found["sigma_deg"][k], reference))
        if error > SIGMAS * sigma or error > np.hypot(found["limit_deg"][k], SIGMAS * reference):
            return False
        # What a record certifies of the mounting must hold there, whatever CameraInfo says.
        certified = names[k] in found.get("mounting_determined", ())
        if certified and found["mounting_error_deg"][k] > np.hypot(found["limit_deg"][k], SIGMAS * reference):
            return False
    return True


def outcome_of(pair: str, line: Mapping[str, Any], good: Mapping[str, Any] | None) -> str:
    """accepted right, accepted WRONG, named, not named, or held as without the fault."""
    found = line["pairs"][pair]
    if found["status"] == "accepted":
        return "accepted, right" if is_right(pair, found, line["rig"]) else "accepted, WRONG"
    before = (good or {"pairs": {}})["pairs"].get(pair)
    if before is not None and before["status"] != "accepted":
        return "not accepted without the fault either"
    wanted = next(c.named for c in CASES if (c.name, c.amount) == (line["case"], line["amount"]))
    if set(found["faults"]) & set(wanted):
        return "stopped, named rightly"
    return "stopped, named otherwise" if found["faults"] else "stopped, not named"


_COLUMNS = (
    "accepted, right",
    "accepted, WRONG",
    "stopped, named rightly",
    "stopped, named otherwise",
    "stopped, not named",
    "not accepted without the fault either",
)


def summary(results: Sequence[Mapping[str, Any]]) -> str:
    """Tables: all faults together, and fault by fault."""
    good = {(r["rig"], r["seed"]): r for r in results if r["case"] == "good"}
    rows: dict[str, dict[str, int]] = {}
    total = dict.fromkeys(_COLUMNS, 0)
    days_named = days_stopped = records = 0
    for line in results:
        if line["case"] == "good":
            continue
        row = rows.setdefault(f"{line['case']} {line['amount']:g}", dict.fromkeys(_COLUMNS, 0))
        outcomes = [outcome_of(pair, line, good.get((line["rig"], line["seed"]))) for pair in line["pairs"]]
        for outcome in outcomes:
            row[outcome] += 1
            total[outcome] += 1
        records += len(outcomes)
        stopped = [o for o in outcomes if o.startswith("stopped")]
        days_stopped += bool(stopped)
        days_named += "stopped, named rightly" in stopped
    stopped = sum(n for name, n in total.items() if name.startswith("stopped"))
    of_good = [(pair, r) for r in good.values() for pair in r["pairs"]]
    held = [(pair, r) for pair, r in of_good if r["pairs"][pair]["faults"]]
    wrong = [
        (p, r)
        for p, r in of_good
        if r["pairs"][p]["status"] == "accepted" and not is_right(p, r["pairs"][p], r["rig"])
    ]
    faulty = len(results) - len(good)
    faulty_seeds = {(r["rig"], r["seed"]) for r in results if r["case"] != "good"}
    everything = (
        f"{records} records of {faulty} faulty vehicle-days, made of {len(faulty_seeds)} distinct days."
    )
    wrong_all = total["accepted, WRONG"]
    stops = (
        f"Accepted and wrong: **{_rate(wrong_all, records)}**. Stopped by the fault: {stopped}, of which "
        f"{total['stopped, named rightly']} name it ({_share(total['stopped, named rightly'], stopped)}); of "
        f"{days_stopped} days with one stopped, {days_named} name it ({_share(days_named, days_stopped)})."
    )
    good_days = (
        f"Good days: {len(good)}, {len(of_good)} records, accepted "
        f"{sum(r['pairs'][p]['status'] == 'accepted' for p, r in of_good)}, wrong {len(wrong)}, "
        f"stopped by a named fault {_rate(len(held), len(of_good))}."
    )
    lines = [
        everything,
        stops,
        good_days,
        "",
        "| fault | " + " | ".join(_COLUMNS) + " |",
        "|---|" + "---|" * len(_COLUMNS),
    ]
    lines += [
        f"| {name} | " + " | ".join(str(n or "") for n in row.values()) + " |" for name, row in rows.items()
    ]
    return "\n".join(lines)


def _rate(hits: int, trials: int) -> str:
    return rate(hits, trials) if trials else "none"


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "none"


def _line(line: Mapping[str, Any]) -> str:
    cells = []
    for pair in PAIRS:
        found = line["pairs"].get(pair)
        if found is None:
            continue
        error = "/".join(f"{e:.3f}" for e in found["error_deg"]) if "error_deg" in found else "-"
        mark = "" if found["status"] != "accepted" or is_right(pair, found, line["rig"]) else " WRONG"
        cells.append(f"{pair} {found['status']}{mark} {error} {','.join(found['faults'])}")
    return (
        f"{line['case']} {line['amount']:g} {line['rig']} {line['seed']}: "
        + "; ".join(cells)
        + f" ({line['cpu_s']} s)"
    )


if __name__ == "__main__":
    main()
