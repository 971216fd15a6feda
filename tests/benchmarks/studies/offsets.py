"""Study: does `joint` find a clock that is late? 40 ms added to the camera's or the radar's delay.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets offsets
    python tests/benchmarks/studies/offsets.py --root DAYS --workers 2

Ten days each, 40 frames, urban and highway in turn, the paper's sensors. Every simulated vehicle has delays of its own
(12 and -18 ms, scattering by 4 ms); the truth is all of it. The prior knows nothing of it: 0 +- 50 ms.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import rms, share

GOAL_S = 0.005


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "offsets").parse_args()
    days = [d for d in SETS["dev-bad"] if ":time:" in d.fault] if args.tuning else SETS["offsets"]
    run_study([Run(day, seed=day.seed) for day in days], args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Every day's offsets, and how many are within the goal."""
    lines = [
        "| day | injected | pair | true [ms] | found [ms] | sigma [ms] | error [ms] | status |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in sorted(results, key=lambda r: r["day"]["seed"]):
        for pair in ("camera_lidar", "lidar_radar"):
            p = r["pairs"].get(pair, {})
            if "dt_s" in p:
                true, found, sigma = (1e3 * p[k] for k in ("dt_true_s", "dt_s", "dt_sigma_s"))
                lines.append(
                    f"| {r['day']['seed']} {r['day']['environment']} | {r['day']['fault']} | {pair} | {true:.1f} "
                    f"| {found:.1f} | {sigma:.1f} | {found - true:+.1f} | {p['status']} |"
                )
    return "\n".join([*lines, "", *(_line(results, pair) for pair in ("camera_lidar", "lidar_radar"))])


def _line(results: list[dict[str, Any]], pair: str) -> str:
    known = [r["pairs"][pair] for r in results if "dt_s" in r["pairs"].get(pair, {})]
    error = np.array([p["dt_s"] - p["dt_true_s"] for p in known])
    sigma = np.array([p["dt_sigma_s"] for p in known])
    return (
        f"- {pair}: within 5 ms {share(np.abs(error) <= GOAL_S)}, RMS error {1e3 * rms(error):.1f} ms, "
        f"RMS error/sigma {rms(error / sigma):.2f}"
    )


if __name__ == "__main__":
    main()
