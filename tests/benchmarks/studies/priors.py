"""Study: from how far does `joint` find home? Priors off by 5 deg/0.3 m, 10 deg/0.5 m and 15 deg/0.7 m.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets coverage
    python tests/benchmarks/studies/priors.py --root DAYS --workers 2

50 trials each: the first ten days of the coverage study, five priors a day, turned and shifted by exactly so much
about random axes (T_camera_lidar and T_lidar_radar independently). The prior's sigmas are these numbers and
`solve.search_rotation_deg`, `solve.search_translation_m` are 1.2 times as much, as one would set them in fleet.toml for
a car that comes out of the workshop like that. Success: azimuth error (azimuth and elevation errors) at the three
targets below 0.2 deg camera-lidar, and below 0.5 deg for both radar pairs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import share

STARTS = ((5.0, 0.3), (10.0, 0.5), (15.0, 0.7))
LIMIT_DEG = {"camera_lidar": 0.2, "camera_radar": 0.5, "lidar_radar": 0.5}


def main() -> None:
    """Run what is missing, then print the table."""
    parser = study_arguments(__doc__ or "", "priors")
    parser.add_argument("--starts", nargs="+", type=_start, default=STARTS, help="DEG,M")
    parser.add_argument("--days", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    days = SETS["dev" if args.tuning else "coverage"][: args.days]
    runs = [
        Run(day, prior=("exact", *start), seed=10 * day.seed + k)
        for start in args.starts
        for day in days
        for k in range(args.seeds)
    ]
    run_study(runs, args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Success and acceptance by start."""
    lines = [
        (
            "| prior off by | trials | camera-lidar az, az+el < 0.2 deg | radar pairs az, az+el < 0.5 deg | all az "
            "| all az+el | accepted pairs | accepted and wrong (az+el) |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    for start in sorted({(r["prior"][1], r["prior"][2]) for r in results}):
        mine = [r["pairs"] for r in results if (r["prior"][1], r["prior"][2]) == start]
        radar = ("camera_radar", "lidar_radar")
        lines.append(
            f"| {start[0]:g} deg / {start[1]:g} m | {len(mine)} | {_both(mine, ('camera_lidar',))} "
            f"| {_both(mine, radar)} | {share(_good(p, PAIRS, ('az_deg',)) for p in mine)} "
            f"| {share(_good(p, PAIRS, ('az_deg', 'el_deg')) for p in mine)} | {_accepted(mine)} |"
        )
    return "\n".join([*lines, "", *_failures(results)])


def _both(mine: list[dict[str, Any]], pairs: tuple[str, ...]) -> str:
    return (
        f"{share(_good(p, pairs, ('az_deg',)) for p in mine)}, "
        f"{share(_good(p, pairs, ('az_deg', 'el_deg')) for p in mine)}"
    )


def _good(pairs: dict[str, Any], names: tuple[str, ...], angles: tuple[str, ...]) -> bool:
    return all(pairs.get(name, {}).get(angle, np.inf) < LIMIT_DEG[name] for name in names for angle in angles)


def _accepted(mine: list[dict[str, Any]]) -> str:
    """Share of pairs accepted, and how many of those are not within the limits."""
    accepted = [
        _good(pairs, (name,), ("az_deg", "el_deg"))
        for pairs in mine
        for name, p in pairs.items()
        if p["status"] == "accepted"
    ]
    return f"{len(accepted)}/{3 * len(mine)} | {sum(not good for good in accepted)}"


def _failures(results: list[dict[str, Any]]) -> list[str]:
    lines = ["Trials that are not home (az+el):", ""]
    for r in results:
        if not _good(r["pairs"], PAIRS, ("az_deg", "el_deg")):
            cells = [
                f"{name} {p['az_deg']:.2f}/{p['el_deg']:.2f} {p['status']}"
                if "az_deg" in p
                else f"{name} refused"
                for name, p in r["pairs"].items()
            ]
            lines.append(
                f"- {r['prior'][1]:g} deg, day {r['day']['seed']}, seed {r['seed']}: {'; '.join(cells)}"
            )
    return lines if len(lines) > 2 else [*lines, "none"]


def _start(text: str) -> tuple[float, float]:
    deg, m = (float(v) for v in text.split(","))
    return deg, m


if __name__ == "__main__":
    main()
