"""Study: does the error of what a vehicle should load fall with the days that it rests on, as its sigma says?

    python -m tests.benchmarks.studies.knocks --root ROOT --seed N
    python -m tests.benchmarks.studies.fused_states --roots ROOT...

Reads the states of every night that `knocks.py` ran (full simulated logs, knocks and bad days among them) and compares
each with the truth of its night; of radars with where its detections point (a constant elevation error is not told from
a turn). States that rest on days before a knock, because the audit waits for the next day, are counted and left out. By
pair and number of days: root mean square of the error of azimuth and elevation at
targets 15 to 40 m away, root mean square of their sigmas, and the share of determined degrees of freedom within one and
three sigmas.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.geometry.targets import errors_at_targets
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import PAIRS
from schemas.states import STATES, StateRow
from tests.benchmarks.studies.commits import commit_now

RESULTS = Path(__file__).resolve().parent.parent / "results" / "fused_states.jsonl"
_KNOCKED_DEG = 0.3  # mountings move by hundredths from day to day
_GROUPS = ((1, 1), (2, 3), (4, 8))  # days that a state rests on


def main() -> None:
    """Measure, print, and add a line to the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--roots", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    found = defaultdict[tuple[str, str], list[dict[str, Any]]](list)
    across = 0
    for root in args.roots:
        truth = _truth(root / "truth")
        for row in read_records(Lake.at(root / "lake"), STATES, StateRow):
            T, days = transform_of(row), len(row.days)
            if T is None or row.covariance is None:
                continue
            now = truth[row.vehicle, row.day][row.pair]
            if any(_turned_deg(truth[row.vehicle, day][row.pair], now) > _KNOCKED_DEG for day in row.days):
                across += 1
                continue
            [group] = [f"{a} to {b} days" for a, b in _GROUPS if a <= days <= b]
            found[row.pair, group].append(_measured(row, T, now))
    told = {p: {f"{a} to {b} days": _told(found[p, f"{a} to {b} days"]) for a, b in _GROUPS} for p in PAIRS}
    line = {"date": f"{datetime.now(UTC):%Y-%m-%d}", "commit": commit_now()}
    line |= {"roots": [r.name for r in args.roots], "across_a_knock": across, "pairs": told}
    with args.out.open("a") as file:
        file.write(json.dumps(line) + "\n")
    print(json.dumps(line, indent=1))


def _truth(folder: Path) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """By vehicle and day the transforms through which detections are where they came from."""
    found = {}
    for file in folder.glob("*/*.json"):
        held = json.loads(file.read_text())
        down = from_rotation_translation(
            exp_so3(np.array([0.0, held["radar_elevation_bias_rad"], 0.0])), np.zeros(3)
        )
        T = {pair: np.array(held[f"T_{pair}"]) for pair in PAIRS}
        found[file.parent.name, file.stem] = {p: m @ down if p.endswith("radar") else m for p, m in T.items()}
    return found


def _turned_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3]))))


def _measured(row: StateRow, T: np.ndarray, T_true: np.ndarray) -> dict[str, Any]:
    assert row.covariance is not None, "only estimates are measured"
    sigma = np.sqrt(np.diag(change_covariance(T, row.covariance)))
    z = change_between(T_true, T) / sigma
    azimuth, elevation, _ = np.degrees(errors_at_targets(row.pair, T, T_true))
    sigmas = np.degrees([row.azimuth_sigma_rad or np.nan, row.elevation_sigma_rad or np.nan])
    return {
        "error": (azimuth, elevation),
        "sigma": sigmas,
        "z": z[np.array(row.observable if row.observable is not None else [True] * 6)],
    }


def _told(states: list[dict[str, Any]]) -> dict[str, Any]:
    if not states:
        return {"states": 0}
    z = np.abs(np.concatenate([s["z"] for s in states]))
    error, sigma = (np.sqrt(np.mean([np.square(s[k]) for s in states], axis=0)) for k in ("error", "sigma"))
    return {
        "states": len(states),
        "az_el_error_deg": [round(float(v), 3) for v in error],
        "az_el_sigma_deg": [round(float(v), 3) for v in sigma],
        "within_1_sigma": round(float(np.mean(z < 1)), 3),
        "within_3_sigma": round(float(np.mean(z < 3)), 3),
    }


if __name__ == "__main__":
    main()
