"""Study: from known perturbations of a given calibration, what does each method find on a real vehicle-day?

A resumable command: every finished run is one line of the JSON Lines file, and is not run again by the same code. Lines
of other code do not count, in the table neither, but for those that `--accept-commits` names.

    boresight ingest --fleet astyx.toml --lake LAKE --vehicle astyx-1 --day 2019-01-14 LOG...
    boresight perceive --fleet astyx.toml --lake LAKE --vehicle astyx-1 --day 2019-01-14
    python tests/benchmarks/recovery.py --fleet astyx.toml --lake LAKE --vehicle astyx-1 --day 2019-01-14 \
        --methods joint,joint-optimisation --starts 2,0.1 5,0.2 10,0.5 --seeds 10 --out recovery.jsonl
    python tests/benchmarks/recovery.py ... --methods joint --starts 5,0.2 --seeds 50 --parts day  # sigmas, 50 starts

The given calibration is the logs' own tf_static. It is no truth: the distance to it says how well methods agree with
whoever calibrated the car, the halves of the day say how well a method agrees with itself, and injected changes of the
radar's own data (turned by 0.3 deg of yaw, shifted by 5 cm of y) say how small a change is found. The search range
follows the start (1.2 times its size, never less than the default). A summary is printed and written beside the lines.
The choice of terms saw this day: nothing here is a first look.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.config import load_fleet
from pipeline.errors import SolveError
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import exp_so3, from_quaternion, inverse, log_se3
from pipeline.geometry.targets import errors_at_targets
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of, perceived
from schemas.calibrations import DOF_NAMES, PAIRS, CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.commits import accept_argument, commit_now, is_accepted
from tests.benchmarks.studies.engine import read_results, search_range
from tests.benchmarks.studies.metrics import inside_share

# Disjoint halves: every other frame sees the same streets, first and second half see different ones.
HALVES = (("even_frames", "odd_frames"), ("first_half", "second_half"))
# Known changes of the radar's data, in radar axes: yaw [deg], y [m].
INJECTED = {"injected_yaw": (0.3, 0.0), "injected_y": (0.0, 0.05)}
PARTS = ("day", *HALVES[0], *HALVES[1], *INJECTED)


def main() -> None:
    """Run what is missing, then print the table."""
    args = _arguments()
    now = commit_now()
    wanted = [
        (method, start, seed, part)
        for method in args.methods.split(",")
        for start in args.starts
        for part in args.parts
        for seed in range(args.seeds if part == "day" else min(args.seeds, args.half_seeds))
    ]
    done = {_key(r) for r in _known(args, now)}
    todo = [run for run in wanted if run not in done]
    with (
        ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool,
        args.out.open("a") as out,
    ):
        jobs = [pool.submit(run_once, args.fleet, args.lake, args.vehicle, args.day, *run) for run in todo]
        for job in jobs:
            result = job.result() | {"commit": now, "date": time.strftime("%Y-%m-%d")}
            out.write(json.dumps(result) + "\n")
            out.flush()
            print(_line(result), flush=True)
    results = _known(args, now)
    text = "\n\n".join([_heading(results), table(results), injections(results), sigma_table(results)]) + "\n"
    args.out.with_suffix(".md").write_text(text)
    print(text)


def run_once(
    fleet_file: Path, lake: str, vehicle: str, day: str, method: str, start: str, seed: int, part: str
) -> dict[str, Any]:
    """One calibration from one perturbed start on one part of the day."""
    fleet = load_fleet(fleet_file)
    partition = Partition(vehicle, day)
    rows = list(observations_of(Lake.at(lake), partition))
    given = read_prior(rows, fleet, vehicle)
    rotation_deg, translation_m = (float(v) for v in start.split(","))
    prior = perturbed(given, (rotation_deg, translation_m), seed)
    fleet = fleet.changed(solve=search_range(("exact", rotation_deg, translation_m)))
    chosen = _part(rows, part)
    began = time.process_time()
    result: dict[str, Any] = {"method": method, "start": start, "seed": seed, "part": part, "pairs": {}}
    result["perceived_by"] = perceived_by(Path(lake), partition)
    try:
        records = calibrate_observations(chosen, prior, fleet, Inputs(partition, method, "study", seed, ()))
    except SolveError as err:
        return result | {"refused": err.reason}
    result["cpu_s"] = round(time.process_time() - began, 1)
    for record in records:
        if record.status == "refused":
            result.setdefault("refused_pairs", {})[record.pair] = record.reason
        else:
            result["pairs"][record.pair] = _measure(record, given.of(record.pair))
    return result


def perceived_by(lake: Path, partition: Partition) -> str:
    """Commit that perceived the day, where `days.py adopt` noted it beside the lake; else the version of the code."""
    note = lake.parent / "done.json"
    if note.exists():
        return str(json.loads(note.read_text()).get("perceived_by", "unknown"))
    manifest = perceived(Lake.at(lake), partition)
    return f"version {manifest.code_version}" if manifest else "unknown"


def _part(rows: list[Observation], part: str) -> list[Observation]:
    """A part of the day, or all of it with the radar's data changed."""
    if part in INJECTED:
        yaw_deg, y_m = INJECTED[part]
        return [changed_radar(o, np.radians(yaw_deg), y_m) for o in rows]
    half = len(rows) // 2
    return {
        "day": rows,
        "even_frames": rows[::2],
        "odd_frames": rows[1::2],
        "first_half": rows[:half],
        "second_half": rows[half:],
    }[part]


def changed_radar(row: Observation, yaw_rad: float, y_m: float) -> Observation:
    """What the radar would have delivered with axes turned by -yaw about its z and an origin y to the right.

    Every point is turned by +yaw and shifted by +y, velocities are turned: T_lidar_radar becomes T_lidar_radar D^-1.
    """
    R = exp_so3(np.array([0.0, 0.0, yaw_rad]))
    shift = np.array([0.0, y_m, 0.0])

    def point(xyz: np.ndarray) -> np.ndarray:
        return (xyz @ R.T + shift).astype(xyz.dtype)

    velocity, covariance = row.radar_velocity_mps, row.radar_velocity_cov
    return replace(
        row,
        radar_xyz_m=point(row.radar_xyz_m),
        radar_track_xyz_m=point(row.radar_track_xyz_m),
        radar_track_velocity_mps=(row.radar_track_velocity_mps @ R.T).astype(
            row.radar_track_velocity_mps.dtype
        ),
        radar_velocity_mps=None if velocity is None else R @ velocity,
        radar_velocity_cov=None if covariance is None else R @ covariance @ R.T,
        radar_drivable_azimuth_rad=row.radar_drivable_azimuth_rad + np.float32(yaw_rad),
    )


def _measure(record: CalibrationRecord, T_given: np.ndarray) -> dict[str, Any]:
    T = from_quaternion(
        np.array([record.qw, record.qx, record.qy, record.qz], np.float64),
        np.array([record.tx_m, record.ty_m, record.tz_m], np.float64),
    )
    azimuth, elevation, range_m = errors_at_targets(record.pair, T, T_given)
    assert record.covariance is not None
    return {
        "az_deg": float(np.degrees(azimuth)),
        "el_deg": float(np.degrees(elevation)),
        "range_m": float(range_m),
        "T": T.tolist(),
        "xi": log_se3(T @ inverse(T_given)).tolist(),
        "sigma": np.sqrt(np.diag(record.covariance)).tolist(),
        "error": change_between(T_given, T).tolist(),
        "error_sigma": np.sqrt(np.diag(change_covariance(T, record.covariance))).tolist(),
        "observable": record.observable,
        "status": record.status,
        "reason": record.reason,
        "time_offset_ms": None if record.time_offset_s is None else record.time_offset_s * 1e3,
        "time_offset_sigma_ms": None
        if record.time_offset_sigma_s is None
        else record.time_offset_sigma_s * 1e3,
        "frames_used": record.frames_used,
    }


def table(results: list[dict[str, Any]]) -> str:
    """Markdown: distance to the given calibration (mean, 95th percentile), agreement of halves, time offsets."""
    lines = [
        (
            "| method | start | runs | pair | az mean / p95 [deg] | el mean / p95 [deg] | range mean / p95 [m] "
            "| accepted | even-odd, first-second half az / el [deg] | dt of day, even, odd, first, second [ms] |"
        ),
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        groups[result["method"], result["start"]].append(result)
    for (method, start), members in groups.items():
        lines += [f"| {method} | {start} | {row} |" for row in _rows(members)]
    return "\n".join(lines)


def injections(results: list[dict[str, Any]]) -> str:
    """What each method finds of a known change: its result on the changed day against that on the day as it is."""
    lines = [
        "| method | start | runs | injected | pair | found yaw [deg] | found y [m] |",
        "|---|---|---|---|---|---|---|",
    ]
    known = {_key(r): r["pairs"] for r in results if r["pairs"]}
    for part, (yaw_deg, y_m) in INJECTED.items():
        groups: dict[tuple[str, str, str], list[np.ndarray]] = defaultdict(list)
        for (method, start, seed, name), pairs in known.items():
            before = known.get((method, start, seed, "day"), {})
            if name == part and "lidar_radar" in pairs and "lidar_radar" in before:
                T, T_before = (np.array(p["lidar_radar"]["T"]) for p in (pairs, before))
                groups[method, start, "lidar_radar"].append(inverse(T) @ T_before)
        for (method, start, pair), found in groups.items():
            yaw = np.degrees([log_se3(D)[2] for D in found])
            y = np.array([D[1, 3] for D in found])
            lines.append(
                f"| {method} | {start} | {len(found)} | yaw {yaw_deg:g} deg, y {y_m:g} m | {pair} "
                f"| {yaw.mean():+.3f} +- {yaw.std():.3f} | {y.mean():+.4f} +- {y.std():.4f} |"
            )
    return "\n".join(lines)


def sigma_table(results: list[dict[str, Any]]) -> str:
    """Does the given calibration lie where the records say? Turns about the child sensor and its position.

    All runs see the same frames: they differ in start and random draws, so this is one day's answer, not a coverage.
    """
    lines = [
        "The given calibration against each record's sigma, whole day, along the parent's axes (deg, m):",
        "",
        "| method | start | pair | DoF | runs | determined | mean error | median sigma | mean z | 1 sigma | 3 sigma |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        if result["part"] == "day":
            groups[result["method"], result["start"]].append(result["pairs"])
    for (method, start), members in groups.items():
        for pair in PAIRS:
            known = [pairs[pair] for pairs in members if "error" in pairs.get(pair, {})]
            lines += [f"| {method} | {start} | {pair} | {row} |" for row in _sigma_rows(known)]
    return "\n".join(lines)


def _sigma_rows(records: list[dict[str, Any]]) -> Iterator[str]:
    """A row per degree of freedom, and one of all that the records call determined by the day."""
    if not records:
        return
    error, sigma = (np.array([r[key] for r in records]) for key in ("error", "error_sigma"))
    determined = np.array([r["observable"] for r in records], bool)
    z = error / sigma
    for k, name in enumerate(DOF_NAMES):
        scale = np.degrees(1.0) if name.startswith("r") else 1.0
        yield (
            f"{name} | {len(z)} | {determined[:, k].sum()} | {scale * error[:, k].mean():+.3f} "
            f"| {scale * np.median(sigma[:, k]):.3f} | {z[:, k].mean():+.2f} | {_inside(z[:, k])}"
        )
    if determined.any():
        of_all = z[determined]
        yield f"all determined | {len(z)} | {determined.sum()} | | | | {_inside(of_all)}"


def _inside(z: np.ndarray) -> str:
    return " | ".join(f"{100 * inside_share(z, np.ones(len(z)), count):.0f} %" for count in (1, 3))


def _rows(members: list[dict[str, Any]]) -> Iterator[str]:
    parts = {p: [m for m in members if m["part"] == p and m["pairs"]] for p in PARTS}
    for pair in ("camera_lidar", "camera_radar", "lidar_radar"):
        day = [m["pairs"][pair] for m in parts["day"] if pair in m["pairs"]]
        if not day:
            continue
        cells = []
        for name in ("az_deg", "el_deg", "range_m"):
            values = np.array([d[name] for d in day])
            cells.append(f"{values.mean():.3f} / {np.percentile(values, 95):.3f}")
        accepted = f"{sum(d['status'] == 'accepted' for d in day)}/{len(day)}"
        known = {p: [m["pairs"][pair] for m in parts[p] if pair in m["pairs"]] for p in PARTS}
        offsets = [_median([r["time_offset_ms"] for r in known[p]]) for p in PARTS if p not in INJECTED]
        halves = "; ".join(_apart(parts[a], parts[b], pair) for a, b in HALVES)
        yield " | ".join([str(len(day)), pair, *cells, accepted, halves, ", ".join(offsets)])


def _apart(first: list[dict[str, Any]], second: list[dict[str, Any]], pair: str) -> str:
    """Mean distance between two halves' results from the same start, at the targets."""
    other = {m["seed"]: m["pairs"][pair] for m in second if pair in m["pairs"]}
    gaps = [
        np.degrees(errors_at_targets(pair, np.array(m["pairs"][pair]["T"]), np.array(other[m["seed"]]["T"])))
        for m in first
        if m["seed"] in other and pair in m["pairs"]
    ]
    return "{:.3f} / {:.3f}".format(*np.mean(gaps, axis=0)[:2]) if gaps else "-"


def _median(values: list[float | None]) -> str:
    known = [v for v in values if v is not None]
    return f"{np.median(known):.1f}" if known else "-"


def _line(result: dict[str, Any]) -> str:
    head = f"{result['method']} {result['start']} seed {result['seed']} {result['part']}"
    if not result["pairs"]:
        return f"{head}: refused: {result.get('refused') or result.get('refused_pairs')}"
    cells = [
        f"{pair} {p['az_deg']:.3f}/{p['el_deg']:.3f}/{p['range_m']:.3f} {p['status']}"
        for pair, p in result["pairs"].items()
    ]
    return f"{head}: {'; '.join(cells)} ({result['cpu_s']} CPU s)"


def _key(result: dict[str, Any]) -> tuple[str, str, int, str]:
    return result["method"], result["start"], result["seed"], result["part"]


def _known(args: argparse.Namespace, now: str) -> list[dict[str, Any]]:
    """Lines that this code made or a person accepts; of one run the newest."""
    lines = [r for r in read_results(args.out) if is_accepted(r["commit"], now, args.accept_commits)]
    return list({_key(r): r for r in lines}.values())


def _heading(results: list[dict[str, Any]]) -> str:
    commits, perceived, dates = (
        ", ".join(sorted({r.get(name, "unknown") for r in results}))
        for name in ("commit", "perceived_by", "date")
    )
    return (
        f"Seen throughout: the choice of terms saw this day.\n\n{len(results)} runs on {dates}; calibrated by commit "
        f"{commits}; perceived by {perceived}"
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fleet", type=Path, required=True)
    parser.add_argument("--lake", required=True)
    parser.add_argument("--vehicle", required=True)
    parser.add_argument("--day", required=True)
    parser.add_argument("--methods", default="joint,joint-optimisation")
    parser.add_argument("--starts", nargs="+", default=["2,0.1", "5,0.2", "10,0.5"])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--half-seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=1)
    accept_argument(parser)
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
