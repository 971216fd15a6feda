"""Study: what does `joint` make of other cars' sensors, and of other worlds?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets dev-rigs
    python tests/benchmarks/studies/rigs.py --root DAYS
    python tests/benchmarks/studies/days.py generate --root DAYS --sets worlds
    python tests/benchmarks/studies/rigs.py --root DAYS --set worlds --out tests/benchmarks/results/worlds.jsonl
    python tests/benchmarks/studies/days.py generate --root DAYS --sets rows
    python tests/benchmarks/studies/rigs.py --root DAYS --set rows --out tests/benchmarks/results/lidar_rows.jsonl

`dev-rigs`: one day of each rig, and of faults of the camera, on `demo`, 40 frames, town and highway mixed.
`worlds`: a world and a rig drawn by each seed, 60 frames, seeds that no tuning saw (`dev-worlds`: tuning
seeds). The prior is drawn with 2 deg and 5 cm. `rows`: lidars of 16 to 128 rows over 60 and 360 deg, on a
street and a motorway. One day says that a rig works or stumbles, and nothing of how often. `far` counts the
sigmas of the DoF that is the farthest off: 3 and more say that a record does not know how wrong it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.simulate.world.landscapes import WORLD, landscape_named
from schemas.calibrations import DOF_NAMES, PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import AZIMUTH_ELEVATION_DOF, within


def main() -> None:
    """Run what is missing, then print the table."""
    parser = study_arguments(__doc__ or "", "rigs")
    parser.add_argument(
        "--set",
        choices=["dev-rigs", "dev-views", "dev-worlds", "worlds", "worlds-full", "rows", "rows-full"],
        default="dev-rigs",
    )
    parser.add_argument("--seeds", nargs="+", type=int, help="of the set, only these days")
    args = parser.parse_args()
    days = [day for day in SETS[args.set] if args.seeds is None or day.seed in args.seeds]
    run_study([Run(day, seed=day.seed) for day in days], args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """A row per day: error in azimuth and elevation, range between lidar and radar, and what became of each pair."""
    heads = [
        "rig",
        "frames",
        *(f"{pair.replace('_', '-')} az/el [deg]" for pair in PAIRS),
        "range [m]",
        "CPU [s]",
    ]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for r in results:
        pairs = r["pairs"]
        frames = max((p.get("frames_used") or 0 for p in pairs.values()), default=0)
        range_m = pairs.get("lidar_radar", {}).get("range_m")
        cells = [
            " ".join(filter(None, (r["day"]["rig"], _world(r["day"]["environment"]), r["day"]["fault"]))),
            str(frames),
            *(_cell(pairs.get(pair)) for pair in PAIRS),
            "-" if range_m is None else f"{range_m:.3f}",
            str(r.get("cpu_s", "-")),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_totals(results)])


def _world(environment: str) -> str:
    """What a drawn world is like, the name of another one; nothing of town and highway in turn."""
    if not environment.startswith(WORLD):
        return "" if environment == "mixed" else environment
    drawn = landscape_named(environment)
    beside = {
        "no markings": not drawn.markings,
        "blind": not drawn.infrared,
        "glass": drawn.glass,
        "low sun": drawn.sun_deg[0] < 15,
    }
    return ", ".join([f"{drawn.base} ({drawn.surface})", *(word for word, is_so in beside.items() if is_so)])


def _totals(results: list[dict[str, Any]]) -> list[str]:
    """By pair over all days: accepted, accepted and beyond the limits, errors in sigmas of certified axes."""
    lines = ["| pair | accepted | wrong and accepted | beyond 3 sigma | RMS sigma |", "|---|---|---|---|---|"]
    for pair in PAIRS:
        found = [r["pairs"].get(pair, {}) for r in results]
        accepted = [p for p in found if p.get("status") == "accepted"]
        wrong = sum(not within(pair, p, claimed=True) for p in accepted)
        dof = list(AZIMUTH_ELEVATION_DOF[pair])
        known = [(np.array(p["error"]) / np.array(p["sigma"]))[dof] for p in found if "error" in p]
        z = np.abs(np.concatenate(known)) if known else np.zeros(1)
        lines.append(
            f"| {pair} | {len(accepted)} of {len(results)} | {wrong} | {(z > 3).sum()} of {len(z)} "
            f"| {np.sqrt(np.mean(z**2)):.2f} |"
        )
    return lines


def _cell(pair: dict[str, Any] | None) -> str:
    if pair is None:
        return "refused"
    if "az_deg" not in pair:
        return f"{pair['status']}: {pair['reason']}"
    z = np.abs(np.array(pair["error"]) / np.array(pair["sigma"]))
    worst = int(np.argmax(z))
    return f"{pair['az_deg']:.3f} / {pair['el_deg']:.3f} {pair['status']}, far {z[worst]:.1f} ({DOF_NAMES[worst]})"


if __name__ == "__main__":
    main()
