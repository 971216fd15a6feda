"""Study: what does `joint` make of other cars' sensors? One day of each rig, and of faults of the camera, on `demo`.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets dev-rigs
    python tests/benchmarks/studies/rigs.py --root DAYS

A day of 40 frames, town and highway mixed, a prior drawn with 2 deg and 5 cm. One day says that a rig works or
stumbles, and nothing of how often; all seeds are tuning seeds. `far` counts the sigmas of the DoF that is the farthest
off: 3 and more say that a record does not know how wrong it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.calibrations import DOF_NAMES, PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "rigs").parse_args()
    run_study([Run(day, seed=day.seed) for day in SETS["dev-rigs"]], args, summary)


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
            " ".join(filter(None, (r["day"]["rig"], r["day"]["fault"]))),
            str(frames),
            *(_cell(pairs.get(pair)) for pair in PAIRS),
            "-" if range_m is None else f"{range_m:.3f}",
            str(r.get("cpu_s", "-")),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


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
