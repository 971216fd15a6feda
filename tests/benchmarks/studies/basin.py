"""Study: does `joint` end in the right basin, on every rig, by day and at dusk, and is what it accepts right?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets basin
    python tests/benchmarks/studies/basin.py --root DAYS --workers 2

One start per day and size. 2 and 5 deg (5 cm) are hidden: the prior states 2 deg and 5 cm, and the search range is the
default one of 6 deg, so 5 deg is more than anybody said. 10 deg / 0.3 m are stated. Right basin: azimuth and elevation
of camera-lidar, and azimuth of lidar-radar, within 0.5 deg of the truth, whatever the verdict says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import share, within

STARTS = (("hidden", 2.0, 0.05), ("hidden", 5.0, 0.05), ("exact", 10.0, 0.3))
_BASIN_DEG = 0.5
_ANGLES = {"camera_lidar": ("az_deg", "el_deg"), "lidar_radar": ("az_deg",)}


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "basin").parse_args()
    days = SETS["dev-basin" if args.tuning else "basin"]
    run_study([Run(day, prior=start, seed=day.seed) for start in STARTS for day in days], args, summary)


def in_basin(pair: str, measured: dict[str, Any]) -> bool:
    """Whether a pair's result lies where only sharper steps are missing."""
    return all(measured.get(angle, float("inf")) < _BASIN_DEG for angle in _ANGLES[pair])


def summary(results: list[dict[str, Any]]) -> str:
    """By start and by rig; then every run that is lost, and every accepted record that is wrong."""
    lines = [
        (
            "| start | days | right basin, camera-lidar | lidar-radar | accepted camera-lidar | lidar-radar "
            "| accepted and wrong, of all pairs |"
        ),
        "|---|---|---|---|---|---|---|",
    ]
    for start in STARTS:
        mine = [r for r in results if tuple(r["prior"]) == start]
        if mine:
            lines.append(_row(f"{start[1]:g} deg / {start[2]:g} m, {start[0]}", mine))
    rigs = dict.fromkeys(r["day"]["rig"] for r in results)
    lines += [_row(f"{rig}, all starts", [r for r in results if r["day"]["rig"] == rig]) for rig in rigs]
    lines.append(_row("all", results))
    return "\n".join([*lines, "", *_lost(results)])


def _row(name: str, runs: Sequence[dict[str, Any]]) -> str:
    cells = [share(in_basin(pair, r["pairs"].get(pair, {})) for r in runs) for pair in _ANGLES]
    cells += [share(r["pairs"].get(pair, {}).get("status") == "accepted" for r in runs) for pair in _ANGLES]
    accepted = [(p, r["pairs"][p]) for r in runs for p in PAIRS if _accepted(r, p)]
    wrong = sum(not within(pair, measured, claimed=True) for pair, measured in accepted)
    return f"| {name} | {len(runs)} | {' | '.join(cells)} | {wrong} of {len(accepted)} |"


def _accepted(result: dict[str, Any], pair: str) -> bool:
    return bool(result["pairs"].get(pair, {}).get("status") == "accepted")


def _lost(results: Sequence[dict[str, Any]]) -> list[str]:
    lines = ["Lost, or accepted and wrong:", ""]
    for r in results:
        lost = [p for p in _ANGLES if not in_basin(p, r["pairs"].get(p, {}))]
        lost += [p for p in PAIRS if _accepted(r, p) and not within(p, r["pairs"][p], claimed=True)]
        if lost:
            what = "; ".join(_words(p, r["pairs"].get(p, {})) for p in dict.fromkeys(lost))
            day = r["day"]
            lines.append(
                f"- {day['rig']} {day['environment']} {day['seed']} {day['fault']}, {r['prior'][1]:g} deg: {what}"
            )
    return lines if len(lines) > 2 else [*lines, "none"]


def _words(pair: str, measured: dict[str, Any]) -> str:
    if "az_deg" not in measured:
        return f"{pair} refused"
    return f"{pair} {measured['az_deg']:.2f}/{measured['el_deg']:.2f} {measured['status']}"


if __name__ == "__main__":
    main()
