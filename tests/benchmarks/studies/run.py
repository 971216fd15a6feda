"""The studies behind the README's rows: how accurate, are sigmas honest, how often accepted and how often wrong.

    python -m tests.benchmarks.studies.run table1 --root DAYS [--methods joint] [--workers 2]
    python -m tests.benchmarks.studies.run coverage --root DAYS
    python -m tests.benchmarks.studies.run worlds --root DAYS [--seeds 7200 7201]
        (or worlds-full, worlds-motion, starts, faults)

Days that are not in DAYS are made first. Lines go to results/STUDY.jsonl, their table to results/STUDY.md.

`table1`: the paper's Table 1; four methods on the same ten days of 100 frames from the same priors, exactly 2 deg and
0.2 m off. Joint-optimisation has a row for each of two readings: each pair's loss divided by its pairwise minimum
(the default), and equation 2 to the letter. A radar's errors are against where its detections point.
`coverage`: 30 days of 40 frames; priors drawn from the normal distribution that their sigmas state.
`worlds`: a world and a rig drawn by each seed, priors drawn with 2 deg and 5 cm. `starts`: some of them, from priors
exactly 2, 5 and 10 deg off. `faults`: days with a fault each, priors as in `worlds`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from schemas.calibrations import DOF_NAMES, PAIRS
from tests.benchmarks.studies.commits import EVERY
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import RESULTS, Run, run_study
from tests.benchmarks.studies.metrics import AZIMUTH_ELEVATION_DOF, inside_share, rms, within

# Rows of table1: a method, and what is changed of its configuration.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "joint": ("joint", {}),
    "joint-optimisation": ("joint-optimisation", {}),
    "joint-optimisation, equation 2 to the letter": ("joint-optimisation", {"paper_loss_scale": "none"}),
    "pairwise-optimisation": ("pairwise-optimisation", {}),
    "tracking": ("tracking", {}),
}
PRIOR = ("exact", 2.0, 0.2)
STARTS_DEG, FOUND_DEG = (2.0, 5.0, 10.0), 0.15
UNITS = (("deg", 180 / np.pi),) * 3 + (("m", 1.0),) * 3
Results = Sequence[dict[str, Any]]


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=["table1", *SUMMARIES])
    parser.add_argument("--root", type=Path, required=True, help="folder of the days")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=int, help="at most so many new runs")
    parser.add_argument("--seeds", nargs="+", type=int, help="of the set, only these days")
    parser.add_argument(
        "--tuning", action="store_true", help="tuning seeds (below 200) in place of test seeds"
    )
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument(
        "--accept-commits", nargs="+", default=[], metavar="COMMIT",
        help=f"lines by these commits count as done ('{EVERY}': by any); otherwise only lines by the same code",
    )  # fmt: skip
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    tuning = "dev-worlds" if args.study in ("worlds", "worlds-full", "worlds-motion", "starts") else "dev"
    days = [
        d for d in SETS[tuning if args.tuning else args.study] if args.seeds is None or d.seed in args.seeds
    ]
    args.out = args.out or RESULTS / f"{'dev_' if args.tuning else ''}{args.study.replace('-', '_')}.jsonl"
    if args.study == "table1":
        rows = {name: METHODS[name] for name in args.methods}
        runs = [Run(d, method, PRIOR, d.seed, solve) for method, solve in rows.values() for d in days]
        run_study(
            runs,
            args,
            table1,
            lambda run: next(n for n, r in METHODS.items() if r == (run.method, run.solve)),
        )
        return
    runs = [Run(day, seed=day.seed) for day in days]
    if args.study == "starts":
        runs = [Run(day, prior=("exact", deg, 0.05), seed=day.seed) for deg in STARTS_DEG for day in days]
    run_study(runs, args, SUMMARIES[args.study], _row_of)


def _row_of(run: Run) -> str:
    """Of `starts` how far off, of `faults` the fault, else the method."""
    return run.day.fault or (f"{run.prior[1]:g} deg" if run.prior[0] == "exact" else run.method)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [heads, ["---"] * len(heads), *rows])


def table1(results: Results) -> str:
    """Mean errors at the targets with their standard errors, row by row; what became of the records."""
    quantities = ("az_deg", "el_deg", "mounting_el_deg", "range_m")
    known = list(dict.fromkeys(r["row"] for r in results))
    body = [
        [name, pair, *(_mean([r for r in results if r["row"] == name], pair, q) for q in quantities)]
        for pair in PAIRS
        for name in known
    ]
    verdicts = [
        [name, *(str(_statuses(results, name).count(s)) for s in ("accepted", "held", "refused"))]
        for name in known
    ]
    heads = ["row", "pair", "az [deg]", "el [deg]", "el against the mounting [deg]", "range [m]"]
    return f"{table(heads, body)}\n\n{table(['row', 'accepted', 'held', 'refused'], verdicts)}"


def _mean(results: Results, pair: str, quantity: str) -> str:
    values = [p[quantity] for r in results if quantity in (p := r["pairs"].get(pair, {}))]
    if len(values) < 2:
        return "-"
    return f"{np.mean(values):.3f} +- {np.std(values, ddof=1) / np.sqrt(len(values)):.3f}"


def _statuses(results: Results, name: str) -> list[str]:
    mine = [r for r in results if r["row"] == name]
    return [r["pairs"].get(pair, {"status": "refused"})["status"] for r in mine for pair in PAIRS]


def coverage(results: Results) -> str:
    """By pair and degree of freedom: error, sigma, their ratio; those that the day determined, then the others."""
    body = []
    for determined in (True, False):
        for pair in PAIRS:
            known = [p for r in results if "error" in (p := r["pairs"].get(pair, {}))]
            for k, name in enumerate(DOF_NAMES):
                members = [p for p in known if bool(p["observable"][k]) is determined]
                error, sigma = (np.array([p[key][k] for p in members]) for key in ("error", "sigma"))
                if not members:
                    continue
                unit, scale = UNITS[k]
                body.append(
                    [
                        "day" if determined else "prior", pair, name, str(len(members)),
                        f"{scale * rms(error):.3f} {unit}", f"{scale * np.median(sigma):.3f} {unit}",
                        f"{rms(error / sigma):.2f}",
                        *(f"{100 * inside_share(error, sigma, n):.1f} %" for n in (1, 3)),
                    ]
                )  # fmt: skip
    heads = ["determined by", "pair", "DoF", "days", "RMS error", "median sigma", "RMS error/sigma"]
    return table([*heads, "inside 1 sigma", "inside 3 sigma"], body)


def worlds(results: Results) -> str:
    """By pair: accepted, accepted and beyond the limits, errors of the certified axes in sigmas."""
    body = []
    for pair in PAIRS:
        found = [r["pairs"].get(pair, {}) for r in results]
        accepted = [p for p in found if p.get("status") == "accepted"]
        wrong = sum(not within(pair, p, claimed=True) for p in accepted)
        dof = list(AZIMUTH_ELEVATION_DOF[pair])
        known = [(np.array(p["error"]) / np.array(p["sigma"]))[dof] for p in found if "error" in p]
        z = np.abs(np.concatenate(known)) if known else np.zeros(1)
        beyond = f"{(z > 3).sum()} of {len(z)}"
        body.append([pair, f"{len(accepted)} of {len(results)}", str(wrong), beyond, f"{rms(z):.2f}"])
    return table(["pair", "accepted", "wrong and accepted", "beyond 3 sigma", "RMS sigma"], body)


def by_row(results: Results) -> str:
    """Of each start or fault: days, camera-lidars within .15 deg, accepted records, those of them that are wrong."""
    body = []
    for name in dict.fromkeys(r["row"] for r in results):
        own = [r["pairs"] for r in results if r["row"] == name]
        accepted = [(pair, p) for pairs in own for pair, p in pairs.items() if p["status"] == "accepted"]
        near = [p for pairs in own if "az_deg" in (p := pairs.get("camera_lidar", {}))]
        found = sum(max(p["az_deg"], p["el_deg"]) <= FOUND_DEG for p in near)
        wrong = sum(not within(pair, p, claimed=True) for pair, p in accepted)
        body.append([name, str(len(own)), str(found), str(len(accepted)), str(wrong)])
    return table(["row", "days", "camera-lidar found", "records accepted", "of these wrong"], body)


SUMMARIES = {
    "coverage": coverage, "worlds": worlds, "worlds-full": worlds, "worlds-motion": worlds, "starts": by_row,
    "faults": by_row,
}  # fmt: skip

if __name__ == "__main__":
    main()
