"""Study: what the learned drivable area of the radar does to calibrations, against the geometric one.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets dev-drivable
    mkdir DAYS/radar_drivable && cp pipeline/learn/models/radar_drivable.* DAYS/radar_drivable
    python tests/benchmarks/studies/drivable.py --root DAYS --workers 2

The network is the one that ships, or one that `boresight train-radar-drivable --out DAYS/radar_drivable` trained: the
fleet that it learned from shares no vehicle, day or scene with the days that are calibrated (see `ssl_fleet.py`). The
methods are the paper's, whose lidar-radar loss holds the overlap of drivable areas; its joint one with losses scaled,
as is our default, and by equation 2 to the letter. The prior is the truth turned by exactly 2 deg and shifted by
exactly 0.2 m, as in Table 1. Runs come in pairs that differ in nothing but the drivable area: read their differences.
Days are tuning days; nothing was tuned on them here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments

__all__ = ["METHODS", "paired"]

_LETTER = {"paper_loss_scale": "none"}
METHODS: dict[str, tuple[str, dict[str, str]]] = {
    "pairwise-optimisation": ("pairwise-optimisation", {}),
    "joint-optimisation": ("joint-optimisation", {}),
    "joint-optimisation, equation 2 to the letter": ("joint-optimisation", _LETTER),
}
PRIOR = ("exact", 2.0, 0.2)
QUANTITIES = ("az_deg", "el_deg", "range_m")


def main() -> None:
    """Run what is missing, then print the table."""
    parser = study_arguments(__doc__ or "", "drivable")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--days", type=int, default=8)
    args = parser.parse_args()
    days = SETS["dev-drivable"][: args.days]
    runs = [
        Run(day, method, PRIOR, day.seed, solve, spoil=area)
        for day in days
        for method, solve in (METHODS[name] for name in args.methods)
        for area in ("", "drivable")
    ]
    run_study(runs, args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Mean error with either area, and the mean difference with its standard error, by method and pair."""
    lines = [
        "| method | pair | days | | geometric | learned | learned - geometric |",
        "|---|---|---|---|---|---|---|",
    ]
    for method in METHODS:
        for pair in PAIRS:
            for quantity in QUANTITIES:
                before, after = paired(results, method, pair, quantity)
                if len(before):
                    change = after - before
                    error = f" +- {change.std(ddof=1) / np.sqrt(len(change)):.3f}" if len(change) > 1 else ""
                    lines.append(
                        f"| {method} | {pair} | {len(before)} | {quantity} | {before.mean():.3f} "
                        f"| {after.mean():.3f} | {change.mean():+.3f}{error} |"
                    )
    return "\n".join(lines)


def paired(
    results: list[dict[str, Any]], method: str, pair: str, quantity: str
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a method of METHODS with the geometric and with the learned area, on the days that have both."""
    found: dict[str, dict[int, float]] = {"": {}, "drivable": {}}
    for result in results:
        value = result["pairs"].get(pair, {}).get(quantity)
        if (result["method"], result["solve"]) == METHODS[method] and value is not None:
            found[result["spoil"]][result["day"]["seed"]] = value
    both = sorted(found[""].keys() & found["drivable"].keys())
    return np.array([found[""][s] for s in both]), np.array([found["drivable"][s] for s in both])


if __name__ == "__main__":
    main()
