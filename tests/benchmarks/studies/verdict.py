"""Study: can `accepted` be believed? Good vehicle-days and days on which something is wrong.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets coverage verdict
    python tests/benchmarks/studies/verdict.py --root DAYS --workers 2

Good days are those of the coverage study (same days, priors and keys: its results are read, not computed again). Bad
days: simulated with permuted label classes, night perception, a camera or radar clock 80 ms late, and a sensor hanging
12 deg off in its bracket, of which tf_static knows nothing; and made of good days at observation level, exactly, since
perceive copies these columns: focal length wrong by 3 %, principal point wrong by 20 px, 2 % of the frames (1 of 40);
and good days with a prior that is 12 deg off unbeknown, twice the search range. A wrong principal point is a turned
camera to any alignment: those days are measured against the truth turned likewise (`engine.reference`).

The precision-recall curve asks every computed record, held ones too, for the angles that its pair is good for: azimuth,
camera-lidar's elevation, and whatever else it vouches for. What vouches for nothing is not right by that.

The score of the precision-recall curve is the record's `diagnostics["confidence"]` where it carries one; else
minus the largest of the 6 sigmas' angles [deg] among the determined ones, so that surer records come first.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.days import SETS, DaySpec
from tests.benchmarks.studies.engine import Run, results_of, run_study, study_arguments
from tests.benchmarks.studies.metrics import AZIMUTH_ELEVATION_DOF, LIMITS_DEG, share, within

DERIVED = ("focal:0.03", "focal:-0.03", "centre:20", "few:1", "hidden prior")


def main() -> None:
    """Run what is missing, then print the tables and draw the curve."""
    parser = study_arguments(__doc__ or "", "verdict")
    parser.add_argument("--coverage", type=Path, help="results of the coverage study (default: beside --out)")
    args = parser.parse_args()
    good = SETS["dev" if args.tuning else "coverage"]
    bad = SETS["dev-bad" if args.tuning else "verdict"]
    runs = [*(_simulated(day) for day in bad), *_derived(good, 2 if args.tuning else 15)]
    known = args.coverage or args.out.with_name("dev_coverage.jsonl" if args.tuning else "coverage.jsonl")
    of_good_days = results_of([Run(day, seed=day.seed) for day in good], args, commit_now(), known).values()
    run_study(runs, args, lambda results: summary([*of_good_days, *results], args.out.with_suffix(".csv")))


def _simulated(day: DaySpec) -> Run:
    turned = day.fault.split(":")[1] in {"yaw", "pitch", "roll"}
    return Run(day, seed=day.seed, prior=("logged", 2.0, 0.05)) if turned else Run(day, seed=day.seed)


def _derived(days: list[DaySpec], count: int) -> Iterator[Run]:
    """Faults at observation level, each on its own stretch of the good days."""
    for number, how in enumerate(DERIVED):
        for i in range(count):
            day = days[(number * count + i) % len(days)]
            if how == "hidden prior":
                yield Run(day, prior=("hidden", 12.0, 0.05), seed=day.seed)
            else:
                yield Run(day, seed=day.seed, spoil=how)


def fault_of(result: dict[str, Any]) -> str:
    """Kind of a vehicle-day in words; empty for a good one."""
    if result["prior"][0] == "hidden":
        return "prior 12 deg off unbeknown"
    if result["spoil"]:
        kind, _, amount = result["spoil"].partition(":")
        return {
            "focal": f"focal length {100 * float(amount or 0):+.0f} %",
            "centre": f"principal point {amount} px",
            "few": "2 % of the frames",
        }[kind]
    sensor, kind, _ = [*result["day"]["fault"].split(":"), "", "", ""][:3]
    return {
        "labels": "label classes permuted",
        "night": "night perception",
        "time": f"{sensor} clock 80 ms late",
        "yaw": f"{sensor} hangs 12 deg off",
        "pitch": f"{sensor} hangs 12 deg off",
    }.get(kind, "")


def summary(results: list[dict[str, Any]], curve: Path) -> str:
    """What is accepted and right, by kind of day; then the curve as CSV and SVG."""
    lines = [
        (
            "| vehicle-days | days | pairs accepted | within limits (az, el) | within limits (claimed angles) "
            "| no worse than the prior |"
        ),
        "|---|---|---|---|---|---|",
    ]
    kinds = sorted({fault_of(r) for r in results})
    lines += [_row(kind or "good", [r for r in results if fault_of(r) == kind]) for kind in kinds]
    lines.append(_row("all bad", [r for r in results if fault_of(r)]))
    lines.append(_row("all", results))
    lines += ["", *_by_pair(results), "", *_wrong(results), ""]
    return "\n".join([*lines, _curve(results, curve)])


def _row(name: str, members: list[dict[str, Any]]) -> str:
    accepted = list(_accepted(members))
    return (
        f"| {name} | {len(members)} | {len(accepted)}/{3 * len(members)} "
        f"({100 * len(accepted) / max(3 * len(members), 1):.0f} %) "
        f"| {share(within(pair, p) for _, pair, p in accepted)} "
        f"| {share(within(pair, p, claimed=True) for _, pair, p in accepted)} "
        f"| {share(not worse_than_prior(pair, p) for _, pair, p in accepted)} |"
    )


def _by_pair(results: list[dict[str, Any]]) -> list[str]:
    lines = ["| pair | good days accepted | accepted of all days within limits (az, el) | (claimed) |"]
    lines.append("|---|---|---|---|")
    for name in PAIRS:
        good = [r["pairs"].get(name, {}).get("status") == "accepted" for r in results if not fault_of(r)]
        accepted = [p for _, pair, p in _accepted(results) if pair == name]
        lines.append(
            f"| {name} | {share(good)} | {share(within(name, p) for p in accepted)} "
            f"| {share(within(name, p, claimed=True) for p in accepted)} |"
        )
    return lines


def _wrong(results: list[dict[str, Any]]) -> list[str]:
    lines = ["Accepted, and a claimed angle beyond its limit:", ""]
    for r, pair, p in _accepted(results):
        if not within(pair, p, claimed=True):
            lines.append(
                f"- day {r['day']['seed']} {fault_of(r)}: {pair} az {p['az_deg']:.2f}, el {p['el_deg']:.2f} deg "
                f"(prior {p['prior_az_deg']:.2f}, {p['prior_el_deg']:.2f})"
            )
    return lines if len(lines) > 2 else [*lines, "none"]


def _accepted(results: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], str, dict[str, Any]]]:
    for r in results:
        for pair, p in r["pairs"].items():
            if p["status"] == "accepted":
                yield r, pair, p


def worse_than_prior(pair: str, measured: dict[str, Any]) -> bool:
    """An angle at the targets is further from truth than the prior's by more than the record's own sigma."""
    for name, k in zip(("az_deg", "el_deg"), AZIMUTH_ELEVATION_DOF[pair], strict=True):
        if measured[name] > measured[f"prior_{name}"] + np.degrees(measured["sigma"][k]):
            return True
    return False


def score_of(pair: str, measured: dict[str, Any]) -> float:
    """How sure a record is: higher is surer; a held record comes after every accepted one."""
    rank = {"accepted": 0.0, "held": -100.0}[measured["status"]]
    if "confidence" in measured["diagnostics"]:
        return rank + float(measured["diagnostics"]["confidence"])
    angles = [
        np.degrees(measured["sigma"][k]) for k in AZIMUTH_ELEVATION_DOF[pair] if measured["observable"][k]
    ]
    return rank - max(angles, default=10.0)


def is_right(pair: str, measured: dict[str, Any]) -> bool:
    """What the pair is good for is within its limit, and whatever else the record vouches for."""
    if pair == "camera_lidar":
        return within(pair, measured)
    return measured["az_deg"] <= LIMITS_DEG[pair] and within(pair, measured, claimed=True)


def precision_recall(scored: list[tuple[float, bool]]) -> list[tuple[float, float, float]]:
    """(score, precision, recall) of taking all records down to each score; recall is of the right records."""
    ordered = sorted(scored, key=lambda s: -s[0])
    right = np.cumsum([good for _, good in ordered])
    total = max(int(right[-1]), 1) if len(right) else 1
    return [
        (score, float(right[i] / (i + 1)), float(right[i] / total)) for i, (score, _) in enumerate(ordered)
    ]


def _curve(results: list[dict[str, Any]], path: Path) -> str:
    """Write the curve of every pair as CSV and draw it."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.0, 3.4), constrained_layout=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pair", "score", "precision", "recall", "accepted"])
        for pair in PAIRS:
            computed = [p for r in results if "az_deg" in (p := r["pairs"].get(pair, {}))]
            points = precision_recall([(score_of(pair, p), is_right(pair, p)) for p in computed])
            accepted = sum(p["status"] == "accepted" for p in computed)
            writer.writerows(
                [pair, f"{s:.4g}", f"{precision:.4f}", f"{recall:.4f}", int(i < accepted)]
                for i, (s, precision, recall) in enumerate(points)
            )
            (line,) = axes.plot([q[2] for q in points], [q[1] for q in points], label=pair.replace("_", "-"))
            if accepted:
                _, precision, recall = points[accepted - 1]
                axes.plot(recall, precision, "o", color=line.get_color())
    axes.set(xlabel="recall of right records", ylabel="precision", ylim=(None, 1.01))
    axes.grid(alpha=0.3)
    axes.legend(title="dot: what is accepted")
    figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})
    plt.close(figure)
    return f"Precision and recall: {path.name}, {path.with_suffix('.svg').name} (dots: what is accepted)"


if __name__ == "__main__":
    main()
