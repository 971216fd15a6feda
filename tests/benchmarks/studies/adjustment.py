"""Study: days of three sensors as they are calibrated now, beside what an earlier commit made of them.

    python tests/benchmarks/studies/adjustment.py DAY... [--out NOW.jsonl] [--against BEFORE.jsonl]

Each DAY is the folder of a simulated day: fleet.toml, truth/, lake/ ingested and perceived. A real day is given as
LAKE:FLEET:VEHICLE:DAY[:TRUTH.json]; without a truth its logged calibration stands in for it. Days start 2 deg and 5 cm
off. BEFORE.jsonl is what `--out` wrote at another commit: the table then has both, and every change of a verdict.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.config import FleetConfig, load_fleet
from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import Prior
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.geometry.se3 import inverse, log_se3
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS, CalibrationRecord
from schemas.observations import Observation
from tests.benchmarks.studies.days import DATE, VEHICLE, Day
from tests.benchmarks.studies.metrics import measure, transform_of, within

Rows = Sequence[Mapping[str, Any]]


def day_of(given: str) -> tuple[str, list[Observation], FleetConfig, Prior, dict[str, Any]]:
    """Name, rows, configuration, logged prior and truth of a folder or a real day."""
    if given.count(":") >= 3:
        lake, toml, vehicle, date, *beside = given.split(":")
        name, truth_file = vehicle, Path(beside[0]) if beside else None
    else:
        folder = Path(given)
        name, vehicle, date, lake, toml = folder.name, VEHICLE, DATE, folder / "lake", folder / "fleet.toml"
        truth_file = folder / "truth" / VEHICLE / f"{DATE}.json"
    fleet = load_fleet(Path(toml))
    rows = list(observations_of(Lake.at(Path(lake)), Partition(vehicle, date)))
    prior = read_prior(rows, fleet, vehicle)
    truth = (
        {f"T_{p}": prior.of(p) for p in PAIRS} if truth_file is None else json.loads(truth_file.read_text())
    )
    truth["T_camera_radar"] = np.array(truth["T_camera_lidar"]) @ np.array(truth["T_lidar_radar"])
    return name, rows, fleet, prior, truth


def row_of(record: CalibrationRecord, prior: Prior, truth: Mapping[str, Any]) -> dict[str, Any]:
    """A record beside the truth; chi-squared is of all six unknowns."""
    day = SimpleNamespace(truth=truth, true_of=lambda pair: np.array(truth[f"T_{pair}"], np.float64))
    T_true = Day.pointing_of(day, record.pair)
    row = measure(record, T_true, prior, None) | {"determined": list(record.determined or [])}
    T = transform_of(record)
    if T is not None and record.covariance is not None:
        off = log_se3(T @ inverse(T_true))
        row["chi_squared"] = float(off @ np.linalg.solve(record.covariance, off))
        for name in ("azimuth", "elevation"):
            row[f"{name}_sigma_deg"] = float(np.degrees(getattr(record, f"{name}_sigma_rad")))
    return row


def solved(given: str, perturb: tuple[float, float] | None, seed: int) -> dict[str, Any]:
    """Records of a day, from one perturbed prior."""
    name, rows, fleet, logged, truth = day_of(given)
    prior, about = (
        perturbed(logged, perturb, seed),
        Inputs(Partition(VEHICLE, DATE), "joint", "study", seed, ()),
    )
    records = calibrate_observations(rows, prior, fleet, about)
    return {"day": name, "seed": seed, "pairs": {r.pair: row_of(r, prior, truth) for r in records}}


def table(ways: Mapping[str, Rows]) -> str:
    """By pair and way: days, errors, sigmas, chi-squared over its expectation, verdicts."""
    lines = [
        "| pair | | days | azimuth, elevation: median (RMS) deg | sigma | chi2 / 6 | accepted | elevation | wrong |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for pair in PAIRS:
        for way, rows in ways.items():
            mine = [p for r in rows if "chi_squared" in (p := r["pairs"].get(pair, {}))]
            if not mine:
                continue
            errors, sigmas = (
                [np.array([m[key] for m in mine]) for key in keys]
                for keys in (("az_deg", "el_deg"), ("azimuth_sigma_deg", "elevation_sigma_deg"))
            )
            accepted = [m for m in mine if m["status"] == "accepted"]
            wrong = sum(not within(pair, m, claimed=True) for m in accepted)
            lines.append(
                f"| {pair} | {way} | {len(mine)} | "
                + ", ".join(f"{np.median(e):.3f} ({np.sqrt(np.mean(e**2)):.3f})" for e in errors)
                + f" | {', '.join(f'{np.median(s):.3f}' for s in sigmas)}"
                f" | {np.mean([m['chi_squared'] for m in mine]) / 6:.2f} | {len(accepted)}"
                f" | {sum('elevation' in m['determined'] for m in accepted)} | {wrong} |"
            )
    return "\n".join(lines)


def changes(before: Rows, now: Rows) -> list[str]:
    """Verdicts that differ, with the reason of the one that is not accepted."""
    earlier = {(r["day"], r["seed"]): r["pairs"] for r in before}
    lines = []
    for row in now:
        for pair, b in row["pairs"].items():
            a = earlier.get((row["day"], row["seed"]), {}).get(pair)
            if a is not None and (a["status"], a["determined"]) != (b["status"], b["determined"]):
                why = next((m["reason"] for m in (a, b) if m["status"] != "accepted"), "")
                what = [f"{m['status']} ({', '.join(m['determined'])})" for m in (a, b)]
                lines.append(f"- {row['day']}, seed {row['seed']}, {pair}: {' -> '.join(what)}: {why}")
    return lines


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file; none where it is missing."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def main() -> None:
    """Calibrate what is missing and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("days", nargs="*")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--perturb", type=float, nargs=2, default=(2.0, 0.05))
    parser.add_argument("--out", type=Path, default=Path("adjustment.jsonl"))
    parser.add_argument("--against", type=Path)
    args = parser.parse_args()
    known = read(args.out)
    done = {(r["day"], r["seed"]) for r in known}
    for given in args.days:
        name = given.split(":")[2] if ":" in given else Path(given).name
        for seed in (s for s in args.seeds if (name, s) not in done):
            try:
                known.append(solved(given, tuple(args.perturb) if args.perturb[0] else None, seed))
            except SolveError as err:
                print(f"{name} {seed}: {err.reason}")
                continue
            with args.out.open("a") as file:
                file.write(json.dumps(known[-1], default=float) + "\n")
    before = read(args.against) if args.against else []
    here = {(r["day"], r["seed"]) for r in known}
    same = [r for r in before if (r["day"], r["seed"]) in here]
    print(table({"before": same, "now": known} if same else {"now": known}))
    print("\n".join(["", *changes(same, known)]))


if __name__ == "__main__":
    main()
