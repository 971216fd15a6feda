"""Study: does the truth lie where `joint` says? One calibration on each of 100 simulated vehicle-days.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets coverage
    python tests/benchmarks/studies/sigma_coverage.py --root DAYS --workers 2

Every day has a seed, a vehicle and streets of its own, 40 frames, urban and highway in turn, the paper's sensors. Its
prior is drawn from the normal distribution that its sigmas state (2 deg and 5 cm per axis, the defaults), so that what
a day leaves at the prior is tested as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.calibrations import DOF_NAMES, PAIRS
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import inside_share, rms

UNITS = (("deg", 180 / np.pi),) * 3 + (("m", 1.0),) * 3


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "coverage").parse_args()
    days = SETS["dev" if args.tuning else "coverage"]
    run_study([Run(day, seed=day.seed) for day in days], args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Coverage per pair and degree of freedom, observable ones and those that keep the prior apart."""
    blocks = [_table(results, observable=True), _table(results, observable=False), _offsets(results)]
    return "\n\n".join([*blocks, _worst(results)])


def _table(results: list[dict[str, Any]], *, observable: bool) -> str:
    title = "Determined by the day" if observable else "Not determined by the day (keeps the prior)"
    lines = [
        f"{title}; turns about the child sensor, its position, along the parent's axes\n",
        "| pair | DoF | days | RMS error | median sigma | RMS error/sigma | inside 1 sigma | inside 3 sigma |",
        "|---|---|---|---|---|---|---|---|",
    ]
    everything: list[float] = []
    for pair in PAIRS:
        known = [r["pairs"][pair] for r in results if "error" in r["pairs"].get(pair, {})]
        for k, name in enumerate(DOF_NAMES):
            members = [m for m in known if bool(m["observable"][k]) is observable]
            if not members:
                continue
            error, sigma = (np.array([m[key][k] for m in members]) for key in ("error", "sigma"))
            everything += list(error / sigma)
            unit, scale = UNITS[k]
            lines.append(
                f"| {pair} | {name} | {len(members)} | {scale * rms(error):.3f} {unit} "
                f"| {scale * np.median(sigma):.3f} {unit} | {_shares(error / sigma)} |"
            )
    z = np.array(everything)
    return "\n".join([*lines, f"| all | all | {len(z)} | | | {_shares(z)} |"])


def _offsets(results: list[dict[str, Any]]) -> str:
    """The same for time offsets."""
    lines = [
        "| time offset of | days | RMS error [ms] | median sigma [ms] | RMS error/sigma | 1 sigma | 3 sigma |"
    ]
    lines.append("|---|---|---|---|---|---|---|")
    for pair in PAIRS:
        known = [r["pairs"][pair] for r in results if r["pairs"].get(pair, {}).get("dt_sigma_s")]
        if not known:
            continue
        error = np.array([m["dt_s"] - m["dt_true_s"] for m in known])
        sigma = np.array([m["dt_sigma_s"] for m in known])
        lines.append(
            f"| {pair} | {len(known)} | {1e3 * rms(error):.1f} | {1e3 * np.median(sigma):.1f} "
            f"| {_shares(error / sigma)} |"
        )
    return "\n".join(lines)


def _worst(results: list[dict[str, Any]]) -> str:
    """Where the truth lies beyond 3 sigma of a determined unknown."""
    lines = ["Beyond 3 sigma, determined unknowns:\n"]
    for r in results:
        for pair, m in r["pairs"].items():
            for k, name in enumerate(DOF_NAMES):
                if "error" in m and m["observable"][k] and abs(m["error"][k]) > 3 * m["sigma"][k]:
                    unit, scale = UNITS[k]
                    lines.append(
                        f"- seed {r['day']['seed']} {r['day']['environment']} {pair} {name}: error "
                        f"{scale * m['error'][k]:+.3f} {unit}, sigma {scale * m['sigma'][k]:.3f}, {m['status']}"
                    )
    return "\n".join(lines if len(lines) > 1 else [*lines, "none"])


def _shares(z: np.ndarray) -> str:
    one = np.ones(len(z))
    return f"{rms(z):.2f} | {100 * inside_share(z, one, 1):.0f} % | {100 * inside_share(z, one, 3):.1f} %"


if __name__ == "__main__":
    main()
