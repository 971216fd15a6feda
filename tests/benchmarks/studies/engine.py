"""The engine of all studies: runs that are not yet in the JSON Lines file, on days perceived before, one line each.

A study is a list of `Run`s and a summary. A run names a day, how its prior is made, the method and changes of the
configuration; its key is all of that, so a study that was stopped goes on where it stood. A line counts only where the
same code made it (`--accept-commits` lets others count), and every table says whether its seeds were seen before.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.core.config import FleetConfig, SolveConfig
from pipeline.core.errors import SolveError
from pipeline.learn.perception_training.radar_drivable import scan_of
from pipeline.perceive.models.radar_drivable import RadarDrivable
from pipeline.rig.day_prior import perturbed, read_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.rig.targets import loop_errors
from pipeline.store.partitions import Partition
from pipeline.verify.axes import check_axes, limits_of
from schemas.calibrations import PAIRS, CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.commits import accept_argument, commit_now, is_accepted
from tests.benchmarks.studies.days import DATE, VEHICLE, Day, DaySpec, load_day
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.metrics import measure, mounting_error, transform_of

__all__ = [
    "DRIVABLE_MODEL",
    "RESULTS",
    "Run",
    "calibrate_once",
    "learned_drivable",
    "prior_of",
    "read_results",
    "results_of",
    "run_study",
    "study_arguments",
    "true_offset_s",
]

# The default sigmas of `rigs.*.prior` in fleet.toml: what a user has who says nothing.
ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M = 2.0, 0.05
RESULTS = Path("tests/benchmarks/results")
IN_USE_ASKED_DEG = (0.5, 1.0)  # of camera-lidar and of pairs with the radar: defaults of `boresight verify`
DRIVABLE_MODEL = Path("radar_drivable") / "radar_drivable.toml"  # under the days' folder
_DIAGNOSTICS = {
    "confidence",
    "vouched_az",
    "vouched_el",
    "holdout_z",
    "loop_rotation_sigma_rad",
    "focal_scale",
    "day_focal_scale",
    "day_focal_sigma",
    *(f"day_centre_{axis}{what}_px" for axis in "uv" for what in ("", "_sigma")),
    "mounting_yaw_sigma_rad",
    "mounting_pitch_sigma_rad",
    "doppler_frames",
    *(
        f"{who}_pitch_{what}_rad"
        for who in ("registration", "boxes", "doppler", "heights")
        for what in ("offset", "sigma")
    ),
}


@dataclass(frozen=True)
class Run:
    """One calibration of a study.

    `prior` is how the prior differs from truth: ("exact", deg, m) turns and shifts both transforms by exactly so much
    in random directions, and its sigmas allow for it; ("hidden", deg, m) does the same and its sigmas know nothing of
    it; ("in use", deg, 0) turns the lidar by deg across the camera's axis and the radar by twice that to a side, as the
    calibration that a car uses goes wrong; ("drawn", deg, m) draws every angle and shift from the normal distribution
    that its sigmas state; ("logged", deg, m) is tf_static with these sigmas. `solve` and `select` replace fields of the
    configuration. `spoil` is what is done to the observations on the way (see `spoiled`).
    """

    day: DaySpec
    method: str = "joint"
    prior: tuple[str, float, float] = ("drawn", ROTATION_SIGMA_DEG, TRANSLATION_SIGMA_M)
    seed: int = 0
    solve: dict[str, Any] = field(default_factory=dict)
    select: dict[str, Any] = field(default_factory=dict)
    spoil: str = ""

    @property
    def key(self) -> str:
        """What tells this run from all others."""
        return key_of(asdict(self))


def key_of(result: dict[str, Any]) -> str:
    """Key of the run that a result line stands for."""
    return json.dumps({f.name: result[f.name] for f in fields(Run)}, sort_keys=True)


def prior_of(day: Day, how: tuple[str, float, float], seed: int) -> Prior:
    """The prior of a run (see `Run`)."""
    kind, deg, shift_m = how
    default = (float(np.radians(ROTATION_SIGMA_DEG)), TRANSLATION_SIGMA_M)
    stated = (float(np.radians(deg)), shift_m)
    true = Prior(day.true_of("camera_lidar"), day.true_of("lidar_radar"), *default)
    if kind == "in use":
        return _turned(true, deg, seed)
    if kind in {"exact", "hidden"}:
        moved = perturbed(true, (deg, shift_m), seed)
        return moved if kind == "exact" else Prior(moved.T_camera_lidar, moved.T_lidar_radar, *default)
    if kind == "logged":
        logged = read_prior(day.rows, day.fleet, next(iter(day.fleet.vehicles)))
        return Prior(logged.T_camera_lidar, logged.T_lidar_radar, *stated)
    rng = np.random.default_rng([seed, 7])
    drawn = [
        from_rotation_translation(
            exp_so3(rng.normal(0, stated[0], 3)) @ T[:3, :3], T[:3, 3] + rng.normal(0, shift_m, 3)
        )
        for T in (true.T_camera_lidar, true.T_lidar_radar)
    ]
    return Prior(drawn[0], drawn[1], *stated)


def _turned(true: Prior, deg: float, seed: int) -> Prior:
    """The truth with the lidar turned by `deg` across the camera's axis, the radar by twice that to a side."""
    rng = np.random.default_rng([seed, 11])
    across, side = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    turns = np.radians(deg) * np.array([[np.cos(across), np.sin(across), 0.0], [0.0, 0.0, 2 * side]])
    moved = [
        from_rotation_translation(exp_so3(turn) @ T[:3, :3], T[:3, 3])
        for turn, T in zip(turns, (true.T_camera_lidar, true.T_lidar_radar), strict=True)
    ]
    return replace(true, T_camera_lidar=moved[0], T_lidar_radar=moved[1])


def search_range(how: tuple[str, float, float]) -> dict[str, float]:
    """`solve.search_*` that contain the prior's error, as its user would set them: 4 sigmas, or 1.2 times an exact one.

    Never less than the defaults, and these where nobody knows that the prior is off.
    """
    factor = {"drawn": 4.0, "exact": 1.2}.get(how[0], 0.0)
    default = SolveConfig()
    return {
        "search_rotation_deg": max(default.search_rotation_deg, factor * how[1]),
        "search_translation_m": max(default.search_translation_m, factor * how[2]),
    }


def spoiled(rows: Sequence[Observation], how: str) -> list[Observation]:
    """Faults that can be put into observations exactly, because perceive hands these columns on as it finds them.

    `focal:F` scales the camera's focal length by 1 + F as a wrong calibration file would; `centre:PX` shifts its
    principal point; `few:N` leaves N frames, spread over the day; `stamps:S` makes the camera's stamps S seconds later
    and the radar's as much earlier, which is all that the simulator's fault `stamp` does. `drivable` is no fault, and
    done before (`_work`).
    """
    if how in {"", "drivable"}:
        return list(rows)
    kind, _, amount = how.partition(":")
    if kind == "few":
        kept = np.unique(np.linspace(0, len(rows) - 1, int(amount)).round().astype(int))
        return [rows[i] for i in kept]
    if kind == "stamps":
        by_ns = round(float(amount) * 1e9)
        return [
            replace(o, camera_stamp_ns=o.camera_stamp_ns + by_ns, radar_stamp_ns=o.radar_stamp_ns - by_ns)
            for o in rows
        ]
    change = np.zeros((3, 3))
    if kind == "focal":
        factor = np.ones((3, 3))
        factor[[0, 1], [0, 1]] += float(amount)
        return [replace(o, camera_K=o.camera_K * factor) for o in rows]
    if kind == "centre":
        change[:2, 2] = float(amount)
        return [replace(o, camera_K=o.camera_K + change) for o in rows]
    raise ValueError(f"no such fault: {how}")


def reference(day: Day, pair: str, spoil: str) -> np.ndarray:
    """What a result is measured against: where detections point, and how a wrong principal point turns the camera.

    A constant elevation error is a turn of the radar for whoever uses its detections: they are what is certified.

    A principal point wrong by d pixels is, but for second order, a camera turned by d / f. No alignment tells the two
    apart, and the pixels fall into place: the pose that does this is the right one for this camera model.
    """
    T = day.pointing_of(pair)
    kind, _, amount = spoil.partition(":")
    if kind != "centre" or not pair.startswith("camera"):
        return T
    K = day.rows[0].camera_K
    turn = np.array([float(amount) / K[1, 1], -float(amount) / K[0, 0], 0.0])
    return from_rotation_translation(exp_so3(turn) @ T[:3, :3], T[:3, 3])


def true_offset_s(day: Day, pair: str, spoil: str) -> float | None:
    """The pair's time offset as `spoil` leaves it; None where nobody knows it."""
    offset_s, (kind, _, amount) = day.truth.get(f"dt_{pair}_s"), spoil.partition(":")
    if offset_s is None or kind != "stamps":
        return offset_s
    return offset_s + float(amount) * (2 if pair == "camera_radar" else 1)


def calibrate_once(run: Run, day: Day) -> dict[str, Any]:
    """Calibrate a day as a run says and measure every pair against truth."""
    camera = day.fleet.rig_of(next(iter(day.fleet.vehicles))).camera.known
    prior = replace(prior_of(day, run.prior, run.seed), camera=camera)
    rows = spoiled(day.rows, run.spoil)
    fleet = _configured(day.fleet, run)
    about = Inputs(Partition(VEHICLE, DATE), run.method, "study", run.seed, ())
    began = time.process_time()
    try:
        records = calibrate_observations(rows, prior, fleet, about)
    except SolveError as err:
        return {"refused": err.reason, "pairs": {}}
    measured = {
        r.pair: measure(r, reference(day, r.pair, run.spoil), prior, true_offset_s(day, r.pair, run.spoil))
        | mounting_error(r, day.true_of(r.pair))
        | ({"in_use": _axes(r, fleet)} if run.prior[0] == "in use" else {})
        for r in records
    }
    out = {"cpu_s": round(time.process_time() - began, 1), "pairs": measured}
    found = {r.pair: T for r in records if (T := transform_of(r)) is not None}
    if set(found) == set(PAIRS):
        azimuth, elevation, range_m = loop_errors(found)
        out["loop"] = [round(float(v), 5) for v in (np.degrees(azimuth), np.degrees(elevation), range_m)]
    return out


def _axes(record: CalibrationRecord, fleet: FleetConfig) -> dict[str, tuple[str, float, float, float]]:
    """What `boresight verify` would say of the prior, by axis: status, distance and sigma [deg], power."""
    checks = check_axes(record, limits_of(record.pair, fleet.verify, IN_USE_ASKED_DEG))
    return {
        c.axis: (c.status, float(np.degrees(c.off_rad)), float(np.degrees(c.sigma_rad)), c.power)
        for c in checks
    }


def run_study(
    runs: Sequence[Run],
    args: argparse.Namespace,
    summary: Callable[[list[dict[str, Any]]], str],
    row_of: Callable[[Run], str] | None = None,
) -> None:
    """Run what is missing, a line per run as it finishes; then print the summary and write it beside the lines.

    Args:
        runs: all runs of the study.
        args: what `study_arguments` parsed.
        summary: Markdown of the results of `runs`.
        row_of: name of the table's row that a run belongs to, kept as `row` in its line; none without it.
    """
    now = commit_now()
    done = results_of(runs, args, now)
    todo = [r for r in runs if r.key not in done][: args.limit]
    about = {"commit": now, "date": time.strftime("%Y-%m-%d")}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    print(f"{len(runs)} runs, {len(todo)} to do", flush=True)
    with (
        ProcessPoolExecutor(args.workers, mp_context=get_context("spawn"), initializer=_quiet) as pool,
        args.out.open("a") as out,
    ):
        jobs = {pool.submit(_work, run, args.root): run for run in todo}
        for number, job in enumerate(as_completed(jobs), 1):
            run = jobs[job]
            if (err := job.exception()) is not None:
                # The others need not wait; this one is missing until it is run again.
                print(f"{number}/{len(todo)} FAILED {run.day.name}: {err!r}", flush=True)
                continue
            result = {**asdict(run), **({"row": row_of(run)} if row_of else {}), **about, **job.result()}
            if not args.tuning:
                result = _small(result)
            out.write(json.dumps(result) + "\n")
            out.flush()
            print(f"{number}/{len(todo)} {_line(result)}", flush=True)
    results = list(results_of(runs, args, now).values())
    if not results:
        return
    text = f"{_heading(results, len(runs), args.out.stem)}\n\n{summary(results)}\n"
    args.out.with_suffix(".md").write_text(text)
    print(text)


def results_of(
    runs: Sequence[Run], args: argparse.Namespace, now: str, path: Path | None = None
) -> dict[str, dict[str, Any]]:
    """Newest line of each run in `args.out` (or `path`) that this code made or a person accepts, by key."""
    wanted = {r.key for r in runs}
    lines = {
        key_of(r): r
        for r in read_results(path or args.out)
        if is_accepted(r["commit"], now, args.accept_commits)
    }
    return {key: line for key, line in lines.items() if key in wanted}


def _heading(results: Sequence[dict[str, Any]], asked: int, study: str) -> str:
    """How much was run, whether its seeds were seen before, by which commits and when."""
    names = {"calibrated": "commit", "perceived": "perceived_by", "simulated": "simulated_by"}
    commits = "; ".join(f"{what} by commit {_all_of(results, name)}" for what, name in names.items())
    return (
        f"{look(study, results)}\n\n{len(results)} of {asked} runs on {_all_of(results, 'date')}; {commits}"
    )


def _all_of(results: Sequence[dict[str, Any]], name: str) -> str:
    return ", ".join(sorted({r.get(name, "unknown") or "nobody" for r in results}))


def study_arguments(description: str, name: str) -> argparse.ArgumentParser:
    """Options that all studies share."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="days that days.py generated")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=int, default=None, help="at most so many new runs")
    parser.add_argument(
        "--tuning", action="store_true", help="tuning seeds (below 200) in place of test seeds"
    )
    accept_argument(parser)
    parser.add_argument("--out", type=Path, default=RESULTS / f"{name}.jsonl")
    return parser


def read_results(path: Path) -> list[dict[str, Any]]:
    """The lines of a result file; none where there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _configured(fleet: FleetConfig, run: Run) -> FleetConfig:
    """The day's configuration with the run's changes, validated like a file's."""
    return fleet.changed(solve=search_range(run.prior) | run.solve, select=run.select)


def learned_drivable(rows: Sequence[Observation], model: Path) -> list[Observation]:
    """The observations as perceive would have written them with this network for the radar's drivable area."""
    network, changed = RadarDrivable(model), []
    for row in rows:
        sector = network.free_sector(scan_of(row))
        changed.append(
            replace(
                row,
                radar_drivable_azimuth_rad=sector.azimuth_rad,
                radar_drivable_range_m=sector.range_m,
            )
        )
    return changed


def _work(run: Run, root: Path) -> dict[str, Any]:
    day = _day(run.day, root)
    if run.spoil == "drivable":
        day = replace(day, rows=learned_drivable(day.rows, root / DRIVABLE_MODEL))
    return day.made_by | calibrate_once(run, day)


@lru_cache(maxsize=4)
def _day(spec: DaySpec, root: Path) -> Day:
    return load_day(spec, root)


def _small(result: dict[str, Any]) -> dict[str, Any]:
    """The result with only those diagnostics that a summary asks for: result files are committed."""
    pairs = {
        pair: p | {"diagnostics": {k: v for k, v in p["diagnostics"].items() if k in _DIAGNOSTICS}}
        if "diagnostics" in p
        else p
        for pair, p in result["pairs"].items()
    }
    return result | {"pairs": pairs}


def _quiet() -> None:
    os.nice(5)


def _line(result: dict[str, Any]) -> str:
    head = f"{result['method']} {DaySpec(**result['day']).name} seed {result['seed']} {result['spoil']}"
    if not result["pairs"]:
        return f"{head}: refused: {result['refused']}"
    cells = [
        f"{pair} {p['az_deg']:.3f}/{p['el_deg']:.3f}/{p['range_m']:.3f} {p['status']}"
        if "az_deg" in p
        else f"{pair} {p['status']}"
        for pair, p in result["pairs"].items()
    ]
    return f"{head}: {'; '.join(cells)} ({result['cpu_s']} CPU s)"
