"""Study: does `boresight verify` let a wrong calibration pass, or fail a right one?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets coverage basin
    python tests/benchmarks/studies/in_use.py --root DAYS --workers 2

Every day of the studies `sigma_coverage` (40 frames, the paper's sensors, urban and highway in turn) and `basin` (eight
rigs, every fifth day at dusk) with the true calibration in
use, and with one that is wrong: camera-lidar by 0.5 deg across the camera's axis in a drawn direction, lidar-radar by
1 deg of yaw. A pair fails where one of its axes does, passes where all that it is good for pass or warn, and is
inconclusive otherwise.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.verify.axes import NEEDED_AXES
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import IN_USE_ASKED_DEG, Run, run_study, study_arguments

_PAIRS = ("camera_lidar", "lidar_radar")
_ANSWERS = ("pass", "fail", "inconclusive")


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "in_use").parse_args()
    days = SETS["dev"] if args.tuning else SETS["coverage"] + SETS["basin"]
    wrong_deg = IN_USE_ASKED_DEG[0]
    runs = [Run(day, seed=day.seed, prior=("in use", deg, 0.0)) for day in days for deg in (0.0, wrong_deg)]
    run_study(runs, args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Answers per pair and of the whole log, for right and wrong calibrations."""
    lines = ["| of | calibration in use | logs | pass | fail | inconclusive |", "|---|---|---|---|---|---|"]
    kinds = {pair: partial(answer_of_pair, pair=pair) for pair in _PAIRS} | {"the log": answer_of_log}
    for name, answer_of in kinds.items():
        for is_wrong in (False, True):
            answers = [answer_of(r) for r in results if (r["prior"][1] > 0) == is_wrong]
            counts = [f"{answers.count(a)} ({answers.count(a) / max(len(answers), 1):.1%})" for a in _ANSWERS]
            lines.append(
                f"| {name} | {'wrong' if is_wrong else 'right'} | {len(answers)} | {' | '.join(counts)} |"
            )
    return "\n".join(lines)


def answer_of_pair(result: dict[str, Any], pair: str) -> str:
    """Of a result line: what the pair's axes amount to; a refused day tells nothing."""
    axes = result["pairs"].get(pair, {}).get("in_use", {})
    statuses = {axis: status for axis, (status, *_) in axes.items()}
    if "fail" in statuses.values():
        return "fail"
    passes = all(statuses.get(axis) in {"pass", "warn"} for axis in NEEDED_AXES[pair])
    return "pass" if passes else "inconclusive"


def answer_of_log(result: dict[str, Any]) -> str:
    """Of all three pairs, as the command's exit code has it."""
    answers = {answer_of_pair(result, pair) for pair in PAIRS}
    return "fail" if "fail" in answers else "pass" if answers == {"pass"} else "inconclusive"


if __name__ == "__main__":
    main()
