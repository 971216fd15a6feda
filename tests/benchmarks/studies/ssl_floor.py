"""Study: what turns alone can reach on the days of Table 1, where every shift stays where the prior has it.

    python -m tests.benchmarks.studies.ssl_floor --root SSL/table1

The turn is chosen knowing the truth, so that azimuth and elevation at the paper's targets are off by as little as they
can be on average. No method that believes the prior's translation is better than that on these days.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.geometry.targets import errors_at_targets
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.looks import look
from tests.benchmarks.studies.ssl_days import open_day, table1_days
from tests.benchmarks.studies.ssl_measures import STARTS

__all__ = ["best_turn_errors"]


def best_turn_errors(pair: str, T_prior: np.ndarray, T_true: np.ndarray) -> tuple[float, float, float]:
    """Azimuth [rad], elevation [rad], range [m] at the paper's targets: the prior's translation, turned at best."""

    def errors(turn_deg: np.ndarray) -> tuple[float, float, float]:
        R = exp_so3(np.radians(turn_deg)) @ T_true[:3, :3]
        return errors_at_targets(pair, from_rotation_translation(R, T_prior[:3, 3]), T_true)

    found = minimize(lambda turn_deg: sum(errors(turn_deg)[:2]), np.zeros(3), method="Nelder-Mead")
    return errors(found.x)


def main() -> None:
    """Print the means over the days, and write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of ssl_fleet.py: table1")
    parser.add_argument("--out", type=Path, default=RESULTS / "ssl_floor.json")
    args = parser.parse_args()
    rows: dict[str, list[tuple[float, float, float]]] = {pair: [] for pair in PAIRS}
    places, now = table1_days(args.root), commit_now()
    for where in places:
        day = open_day(where)
        prior = day.prior(*STARTS["prior"], seed=where.seed)
        for pair in PAIRS:
            rows[pair].append(best_turn_errors(pair, prior.of(pair), day.true_of(pair)))
    means = {pair: np.mean(found, axis=0) * [*np.degrees([1, 1]), 1] for pair, found in rows.items()}
    seeds = look(args.out.stem, [{"day": {"seed": where.seed}, "commit": now} for where in places])
    result = {"date": time.strftime("%Y-%m-%d"), "commit": now, "seeds": seeds, "az_el_deg_range_m": {}}
    result["az_el_deg_range_m"] = {pair: [round(float(v), 4) for v in mean] for pair, mean in means.items()}
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
