"""Study: does `joint` end in the right basin, on every rig, by day and at dusk, and is what it accepts right?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets basin
    python tests/benchmarks/studies/basin.py --root DAYS --workers 2

One start per day and size. 2 and 5 deg (5 cm) are hidden: the prior states 2 deg and 5 cm, and the search range is the
default one of 6 deg, so 5 deg is more than anybody said. 10 deg / 0.3 m are stated. Right basin: azimuth and elevation
of camera-lidar, and azimuth of lidar-radar, within 0.5 deg of the truth, whatever the verdict says.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets basin-starts
    python tests/benchmarks/studies/basin.py --root DAYS --starts 12 --lake world=FOLDER --out basin_starts.jsonl

So many starts per day of exactly 2, 5, 10 and 15 deg (5, 10, 20, 30 cm) in random directions, as they are stated, with
all frames of the day and with ten; `--set basin-starts-2` has other days, `--sizes` and `--frames` choose a part.
`--lake NAME=FOLDER` adds a day of another origin: FOLDER has fleet.toml, a lake that was perceived, and maybe
truth.json (else its logged calibration is the reference).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.store.partitions import Lake
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS, DaySpec, adopt_day
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import share, within

STARTS = (("hidden", 2.0, 0.05), ("hidden", 5.0, 0.05), ("exact", 10.0, 0.3))
EXACT = (("exact", 2.0, 0.05), ("exact", 5.0, 0.1), ("exact", 10.0, 0.2), ("exact", 15.0, 0.3))
FRAMES = (100, 10)
_BASIN_DEG = 0.5
_ANGLES = {"camera_lidar": ("az_deg", "el_deg"), "lidar_radar": ("az_deg",)}


def main() -> None:
    """Run what is missing, then print the table."""
    parser = study_arguments(__doc__ or "", "basin")
    parser.add_argument("--starts", type=int, default=0, help="exact starts per day and size")
    parser.add_argument("--lake", nargs="*", default=[], help="NAME=FOLDER of days of other origin")
    parser.add_argument("--only-lakes", action="store_true", help="no simulated days")
    parser.add_argument("--set", choices=["basin-starts", "basin-starts-2"], default="basin-starts")
    parser.add_argument(
        "--sizes", type=float, nargs="+", default=[s[1] for s in EXACT], help="of exact starts [deg]"
    )
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES, help="frames of exact starts")
    args = parser.parse_args()
    if not args.starts:
        days = SETS["dev-basin" if args.tuning else "basin"]
        run_study([Run(day, prior=start, seed=day.seed) for start in STARTS for day in days], args, summary)
        return
    made = [] if args.only_lakes else SETS["dev-basin" if args.tuning else args.set]
    days = [*made, *(_adopted(x, args.root) for x in args.lake)]
    runs = [
        Run(day, prior=start, seed=100 * day.seed + number, select={"frames": frames})
        for number in range(args.starts)
        for start in EXACT
        if start[1] in args.sizes
        for frames in args.frames
        for day in days
    ]
    run_study(runs, args, by_start)


def _adopted(named: str, root: Path) -> DaySpec:
    """A day of another origin, put into the root unless it is there."""
    name, _, where = named.partition("=")
    spec, folder = DaySpec(0, name, 0, "real"), Path(where)
    if not (root / spec.name).exists():
        lake, truth = folder / "lake", folder / "truth.json"
        [partition] = Lake.at(str(lake)).partitions("perceived")
        adopt_day(folder / "fleet.toml", str(lake), partition, root, spec, truth if truth.exists() else None)
    return spec


def by_start(results: list[dict[str, Any]]) -> str:
    """Camera-lidar by size of start and frames, then by day; then every right end that the search doubted."""
    lines = ["| start | runs | right basin | accepted | right and doubted | accepted and wrong | CPU s |"]
    lines.append("|---|---|---|---|---|---|---|")
    for how in dict.fromkeys(_size(r) for r in sorted(results, key=_size)):
        mine = [r for r in results if _size(r) == how]
        lines.append(_exact_row(f"{how[1]:g} deg, {how[0]} frames", mine))
    for day in dict.fromkeys((r["day"]["rig"], r["day"]["environment"]) for r in results):
        mine = [r for r in results if (r["day"]["rig"], r["day"]["environment"]) == day]
        lines.append(_exact_row(" ".join(day), mine))
    return "\n".join([*lines, "", *_lost(results, ("camera_lidar",))])


def _size(result: dict[str, Any]) -> tuple[int, float]:
    return result["select"]["frames"], result["prior"][1]


def _exact_row(name: str, runs: Sequence[dict[str, Any]]) -> str:
    pairs = [r["pairs"].get("camera_lidar", {}) for r in runs]
    right = [in_basin("camera_lidar", p) for p in pairs]
    accepted = [p.get("status") == "accepted" for p in pairs]
    doubted = [r and "of the search" in p.get("reason", "") for r, p in zip(right, pairs, strict=True)]
    wrong = [a and not within("camera_lidar", p, claimed=True) for a, p in zip(accepted, pairs, strict=True)]
    cells = [share(x) for x in (right, accepted, doubted, wrong)]
    cpu = sum(r.get("cpu_s", 0.0) for r in runs) / len(runs)
    return f"| {name} | {len(runs)} | {' | '.join(cells)} | {cpu:.1f} |"


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


def _lost(results: Sequence[dict[str, Any]], pairs: Sequence[str] = PAIRS) -> list[str]:
    lines = ["Lost, or accepted and wrong:", ""]
    for r in results:
        lost = [p for p in _ANGLES if p in pairs and not in_basin(p, r["pairs"].get(p, {}))]
        lost += [p for p in pairs if _accepted(r, p) and not within(p, r["pairs"][p], claimed=True)]
        if lost:
            what = "; ".join(_words(p, r["pairs"].get(p, {})) for p in dict.fromkeys(lost))
            day = r["day"]
            lines.append(
                f"- {day['rig']} {day['environment']} {day['seed']} {day['fault']}, {r['prior'][1]:g} deg "
                f"{r.get('select', '')}: {what}"
            )
    return lines if len(lines) > 2 else [*lines, "none"]


def _words(pair: str, measured: dict[str, Any]) -> str:
    if "az_deg" not in measured:
        return f"{pair} refused"
    return f"{pair} {measured['az_deg']:.2f}/{measured['el_deg']:.2f} {measured['status']}"


if __name__ == "__main__":
    main()
