"""Study: the paper's Table 1 on simulated days: four methods on the same ten days from the same priors.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets table1
    python tests/benchmarks/studies/table1.py --root DAYS --workers 2

Five urban and five highway days, 100 frames each, the paper's sensors. The prior is the truth turned by exactly 2 deg
and shifted by exactly 0.2 m (T_camera_lidar and T_lidar_radar, random directions by the day's seed). Errors are mean
absolute azimuth, elevation and range at the paper's three targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS, DaySpec
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import share

__all__ = ["METHODS", "cell", "errors_table", "verdicts_table"]

METHODS = ("joint", "joint-optimisation", "pairwise-optimisation", "tracking")
PRIOR = ("exact", 2.0, 0.2)
QUANTITIES = (("az_deg", "az [deg]"), ("el_deg", "el [deg]"), ("range_m", "range [m]"))


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = study_arguments(__doc__ or "", "table1")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    args = parser.parse_args()
    days = SETS["table1"]
    if args.tuning:
        days = [DaySpec(101 + i, ("urban", "highway")[i % 2], 100) for i in range(3)]
    runs = [Run(day, method, PRIOR, day.seed) for method in args.methods for day in days]
    run_study(runs, args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Mean errors and their standard errors, all days, urban, highway; ratios of joint to the others; the loop."""
    parts = [errors_table(results, environment) for environment in ("", "urban", "highway")]
    return "\n\n".join([*parts, _ratios(results), _loop(results), verdicts_table(results)])


def errors_table(results: list[dict[str, Any]], environment: str, methods: Sequence[str] = METHODS) -> str:
    """Mean errors of the methods, pair by pair; `environment` is empty for all days."""
    lines = [
        f"{environment or 'All'} days, mean +- standard error over days:\n",
        "| method | pair | days | az [deg] | el [deg] | range [m] |",
        "|---|---|---|---|---|---|",
    ]
    chosen = [r for r in results if environment in ("", r["day"]["environment"])]
    for pair in PAIRS:
        cells = " | ".join(cell(_values(chosen, methods[0], pair, f"prior_{q}")) for q, _ in QUANTITIES)
        lines.append(f"| (prior) | {pair} | {_count(chosen, methods[0], pair)} | {cells} |")
        for method in methods:
            cells = " | ".join(cell(_values(chosen, method, pair, q)) for q, _ in QUANTITIES)
            lines.append(f"| {method} | {pair} | {_count(chosen, method, pair)} | {cells} |")
    return "\n".join(lines)


def _ratios(results: list[dict[str, Any]]) -> str:
    """Mean error of joint over that of another method, on the days that both have."""
    lines = ["joint over", "", "| method | pair | az | el | range |", "|---|---|---|---|---|"]
    for other in METHODS[1:]:
        for pair in PAIRS:
            cells = []
            for quantity, _ in QUANTITIES:
                a, b = (_by_seed(results, m, pair, quantity) for m in ("joint", other))
                both = sorted(set(a) & set(b))
                cells.append(
                    f"{np.mean([a[s] for s in both]) / np.mean([b[s] for s in both]):.2f}" if both else "-"
                )
            lines.append(f"| {other} | {pair} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _loop(results: list[dict[str, Any]]) -> str:
    """The loop as the methods leave it, and for joint that of the estimate which never saw the lidar."""
    lines = []
    for method in METHODS:
        loops = [r["loop"] for r in results if r["method"] == method and "loop" in r]
        if loops:
            mean = np.mean(loops, axis=0)
            lines.append(
                f"- {method}: loop az/el/range {mean[0]:.3f} deg / {mean[1]:.3f} deg / {mean[2]:.3f} m"
            )
    found = [
        (p["loop_rotation_rad"], p["diagnostics"]["loop_rotation_sigma_rad"])
        for r in results
        if r["method"] == "joint"
        and (p := r["pairs"].get("camera_radar", {})).get("loop_rotation_rad") is not None
        and "loop_rotation_sigma_rad" in p.get("diagnostics", {})
    ]
    inside = share(angle <= 3 * sigma for angle, sigma in found)
    angle = np.degrees(np.mean([a for a, _ in found])) if found else float("nan")
    lines.append(
        f"- joint's loop of independent pairs (camera-radar without the lidar; zero by construction above): "
        f"mean angle {angle:.3f} deg, inside its 3 sigma {inside}"
    )
    return "\n".join(["Loops:", "", *lines])


def verdicts_table(results: list[dict[str, Any]], methods: Sequence[str] = METHODS) -> str:
    """How many records were accepted, held and refused, and what a day took."""
    lines = ["| method | accepted | held | refused | CPU s |", "|---|---|---|---|---|"]
    for method in methods:
        mine = [r for r in results if r["method"] == method]
        status = [p["status"] for r in mine for p in r["pairs"].values()]
        status += ["refused"] * sum(3 for r in mine if not r["pairs"])
        counts = " | ".join(str(status.count(s)) for s in ("accepted", "held", "refused"))
        seconds = [r["cpu_s"] for r in mine if "cpu_s" in r]
        lines.append(f"| {method} | {counts} | {np.mean(seconds) if seconds else float('nan'):.1f} |")
    return "\n".join(["Records (pairs x days):", "", *lines])


def _by_seed(results: list[dict[str, Any]], method: str, pair: str, quantity: str) -> dict[int, float]:
    return {
        r["day"]["seed"]: r["pairs"][pair][quantity]
        for r in results
        if r["method"] == method and quantity in r["pairs"].get(pair, {})
    }


def _values(results: list[dict[str, Any]], method: str, pair: str, quantity: str) -> np.ndarray:
    return np.array(list(_by_seed(results, method, pair, quantity).values()))


def _count(results: list[dict[str, Any]], method: str, pair: str) -> int:
    return len(_by_seed(results, method, pair, "az_deg"))


def cell(values: np.ndarray) -> str:
    """Mean and standard error."""
    if not len(values):
        return "-"
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return f"{values.mean():.3f} +- {error:.3f}"


if __name__ == "__main__":
    main()
