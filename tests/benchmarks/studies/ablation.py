"""Study: what is each term of `joint` worth, how many frames does it need, how good a prior, on which rig?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets ablation
    python tests/benchmarks/studies/days.py adopt --root DAYS --fleet astyx.toml --lake LAKE --vehicle V --day D
    python tests/benchmarks/studies/ablation.py --root DAYS --workers 2 --real

One command: every term off, one at a time; 10, 30 and 100 frames; priors off by 2, 5, 10 and 15 deg; on the paper's
sensors (urban and highway), a 16-ring lidar, and both with a radar that measures no elevation. The real day has no
truth: there the difference is to the logged calibration.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.config import TERMS
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import REAL, SETS, DaySpec
from tests.benchmarks.studies.engine import Run, run_study, study_arguments

FRAMES = (10, 30, 100)
PRIORS = ((2.0, 0.1), (5.0, 0.3), (10.0, 0.5), (15.0, 0.7))


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = study_arguments(__doc__ or "", "ablation")
    parser.add_argument("--seeds", type=int, default=2, help="priors per setting and day")
    parser.add_argument("--real", action="store_true", help="and on the adopted real day")
    args = parser.parse_args()
    days = SETS["dev"][:2] if args.tuning else SETS["ablation"]
    days = [*days, REAL] if args.real else days
    run_study([run for day in days for run in _settings(day, args.seeds)], args, summary)


def _settings(day: DaySpec, seeds: int) -> list[Run]:
    """All settings of a day: each differs from the first in one thing."""
    out = []
    for k in range(seeds):
        seed = 10 * day.seed + k
        base = ("exact", *PRIORS[0])
        out.append(Run(day, prior=base, seed=seed))
        out += [
            Run(day, prior=base, seed=seed, solve={"terms": [t for t in TERMS if t != off]}) for off in TERMS
        ]
        out += [Run(day, prior=base, seed=seed, select={"frames": n}) for n in FRAMES[:-1]]
        out += [Run(day, prior=("exact", *start), seed=seed) for start in PRIORS[1:]]
    return out


def setting_of(result: dict[str, Any]) -> str:
    """What differs from the whole `joint` on 100 frames from 2 deg, in words."""
    if "terms" in result["solve"]:
        (off,) = set(TERMS) - set(result["solve"]["terms"])
        return f"without {off.replace('_', ' ')}"
    if result["select"]:
        return f"{result['select']['frames']} frames"
    deg, m = result["prior"][1:]
    return "all" if (deg, m) == PRIORS[0] else f"prior {deg:g} deg / {m:g} m"


def summary(results: list[dict[str, Any]]) -> str:
    """A table per day and rig: rows are settings, columns the pairs' errors at the targets."""
    blocks = []
    for day in sorted({DaySpec(**r["day"]) for r in results}, key=lambda d: d.seed):
        mine = [r for r in results if DaySpec(**r["day"]) == day]
        lines = [
            f"{day.rig}, {day.environment}, seed {day.seed}; mean az / el [deg] / range [m], accepted of runs\n",
            f"| setting | runs | {' | '.join(p.replace('_', '-') for p in PAIRS)} |",
            "|---|---|---|---|---|",
        ]
        for setting in dict.fromkeys(setting_of(r) for r in mine):
            members = [r["pairs"] for r in mine if setting_of(r) == setting]
            cells = " | ".join(_cell([m.get(pair, {}) for m in members]) for pair in PAIRS)
            lines.append(f"| {setting} | {len(members)} | {cells} |")
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _cell(members: list[dict[str, Any]]) -> str:
    known = [m for m in members if "az_deg" in m]
    if not known:
        return "refused"
    means = [np.mean([m[q] for m in known]) for q in ("az_deg", "el_deg", "range_m")]
    accepted = sum(m["status"] == "accepted" for m in members)
    return f"{means[0]:.3f} / {means[1]:.3f} / {means[2]:.3f}, {accepted}/{len(members)}"


if __name__ == "__main__":
    main()
