"""What the demo fleet's records are off by, whether their sigmas hold, and whether the knock was found.

    boresight demo --out demo
    python tests/benchmarks/studies/demo.py --demo demo

Everything is read from the demo's own tables and truth; the file that is written holds every number of the demo that
documents state. Errors are mean absolute azimuth, elevation and range at the paper's targets, over the days that a
method was asked for.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.targets import errors_at_targets
from pipeline.report.truth import Truth, read_truth, true_transform
from pipeline.store.current import current_drift, current_records, prior_of, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.metrics import inside_share, measure

__all__ = ["measure_demo"]


def measure_demo(folder: Path) -> dict[str, Any]:
    """Errors by method and pair, coverage of the determined degrees of freedom, and what moved."""
    lake, truth = Lake.at(folder / "lake"), read_truth(folder / "truth")
    records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
    found: dict[str, Any] = {}
    for method in sorted({r.method for r in records}):
        own = [r for r in records if r.method == method]
        found[method] = {pair: _errors([r for r in own if r.pair == pair], truth) for pair in PAIRS}
        found[method] |= _coverage(own, truth)
        found[method]["accepted"] = f"{sum(r.status == 'accepted' for r in own)} of {len(own)}"
    return {"methods": found, "moved": _moved(current_drift(read_records(lake, DRIFT, DriftFinding)))}


def _errors(records: Sequence[CalibrationRecord], truth: Truth) -> dict[str, Any]:
    """Azimuth [deg], elevation [deg], range [m] of the records of one pair, and of their priors."""
    out: dict[str, Any] = {"records": 0}
    for name, of in (("prior", prior_of), ("found", transform_of)):
        known = [(r.pair, T, true_transform(truth, r)) for r in records if (T := of(r)) is not None]
        if known:
            errors = np.mean([errors_at_targets(*k) for k in known], axis=0) * [*np.degrees([1, 1]), 1]
            out |= {f"{name}_az_el_deg_range_m": [round(float(v), 4) for v in errors]}
        out["records"] = len(known)
    return out


def _coverage(records: Sequence[CalibrationRecord], truth: Truth) -> dict[str, Any]:
    """Share of the determined degrees of freedom within one and three of their sigmas."""
    z = []
    for record in records:
        T_true = true_transform(truth, record)
        measured = measure(record, T_true, Prior(T_true, T_true, 1.0, 1.0), None)
        if "error" in measured:
            determined = np.array(measured["observable"], bool)
            z += list((np.array(measured["error"]) / np.array(measured["sigma"]))[determined])
    ones = np.ones(len(z))
    shares = [round(inside_share(np.array(z), ones, count), 3) if z else None for count in (1, 3)]
    return {"determined": len(z), "inside_1_sigma": shares[0], "inside_3_sigma": shares[1]}


def _moved(findings: Sequence[DriftFinding]) -> dict[str, Any]:
    """By vehicle: how many charts have which status, and the sensor that moved, with its motion."""
    out: dict[str, Any] = {}
    for vehicle in sorted({f.vehicle for f in findings}):
        own = [f for f in findings if f.vehicle == vehicle]
        moved = next((f for f in own if f.moved_sensor), None)
        out[vehicle] = {
            "charts": {s: sum(f.status == s for f in own) for s in sorted({f.status for f in own})}
        }
        if moved is not None and moved.moved_motion and moved.moved_motion_sigma:
            turn, sigma = (
                np.degrees(v[:3]).round(3).tolist() for v in (moved.moved_motion, moved.moved_motion_sigma)
            )
            out[vehicle] |= {
                "sensor": moved.moved_sensor,
                "since": moved.start_day,
                "turn_deg": turn,
                "sigma_deg": sigma,
            }
    return out


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demo", type=Path, default=Path("demo"), help="folder that `boresight demo` wrote")
    parser.add_argument("--out", type=Path, default=RESULTS / "demo.json")
    args = parser.parse_args()
    about = {"date": time.strftime("%Y-%m-%d"), "commit": commit_now(), "fleet_seed": 1}
    text = json.dumps(about | measure_demo(args.demo), indent=1)
    args.out.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
