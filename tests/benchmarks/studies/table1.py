"""Study: the paper's Table 1 on simulated days: four methods on the same ten days from the same priors.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets table1 one-clock
    python tests/benchmarks/studies/days.py gather --root DAYS --sets dev --out FLEET
    boresight train-perception radar_drivable --fleet FLEET/fleet.toml --lake FLEET/lake --out DAYS/radar_drivable
    python tests/benchmarks/studies/table1.py --root DAYS --workers 2
    python tests/benchmarks/studies/table1.py --root DAYS --workers 2 --days one-clock

Five urban and five highway days, 100 frames each, the paper's sensors. The prior is the truth turned by exactly 2 deg
and shifted by exactly 0.2 m (T_camera_lidar and T_lidar_radar, random directions by the day's seed). Errors are mean
absolute azimuth, elevation and range at the paper's three targets; a radar's against where its detections point, and
its elevation against the mounting as well, which differs by the radar's own constant error (.15 deg).

The paper's joint-optimisation has a row for each of two readings: each pair's loss divided by its pairwise minimum (the
default), and equation 2 to the letter. Its losses use the radar's drivable area: rows "learned drivable areas" take it
from a network that learned on another fleet (see `drivable.py`), the others from geometry. Vehicles of the set table1
have clocks that differ by 12 and 18 ms, which only `joint` estimates; those of one-clock have a single one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.days import SETS, DaySpec
from tests.benchmarks.studies.engine import DRIVABLE_MODEL, RESULTS, Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import share

__all__ = ["ROWS", "Row", "cell", "errors_table", "row_of", "verdicts_table"]


@dataclass(frozen=True)
class Row:
    """A row of the table: a method and what is changed of its configuration and of the days (see `Run`)."""

    name: str
    method: str
    solve: dict[str, Any] = field(default_factory=dict)
    spoil: str = ""


_LETTER = {"paper_loss_scale": "none"}
_LETTER_NAME = "joint-optimisation, equation 2 to the letter"
_LEARNED = "learned drivable areas"
ROWS = (
    Row("joint", "joint"),
    Row("joint-optimisation", "joint-optimisation"),
    Row(_LETTER_NAME, "joint-optimisation", _LETTER),
    Row("pairwise-optimisation", "pairwise-optimisation"),
    Row("tracking", "tracking"),
    Row(f"joint-optimisation, {_LEARNED}", "joint-optimisation", spoil="drivable"),
    Row(f"{_LETTER_NAME}, {_LEARNED}", "joint-optimisation", _LETTER, "drivable"),
    Row(f"pairwise-optimisation, {_LEARNED}", "pairwise-optimisation", spoil="drivable"),
)
METHODS = tuple(dict.fromkeys(row.method for row in ROWS))
NAMES = tuple(row.name for row in ROWS)
PRIOR = ("exact", 2.0, 0.2)
QUANTITIES = (
    ("az_deg", "az [deg]"),
    ("el_deg", "el [deg]"),
    ("mounting_el_deg", "el against the mounting [deg]"),
    ("range_m", "range [m]"),
)


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = study_arguments(__doc__ or "", "table1")
    parser.set_defaults(out=None)
    parser.add_argument("--days", choices=["table1", "one-clock"], default="table1", help="set of days.py")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    args = parser.parse_args()
    if args.tuning and args.days == "one-clock":
        parser.error("there are no tuning days of one-clock")
    if args.out is None:
        name = "table1" if args.days == "table1" else "table1_one_clock"
        args.out = RESULTS / f"{'dev_' if args.tuning else ''}{name}.jsonl"
    rows = [row for row in rows_for(args.root) if row.method in args.methods]
    days = SETS["dev"][:3] if args.tuning else SETS[args.days]
    run_study(runs_of(rows, days), args, summary, row_name)


def rows_for(root: Path) -> list[Row]:
    """Rows that can be had: without a learned model, those without it, and a line says why."""
    if (root / DRIVABLE_MODEL).exists():
        return list(ROWS)
    print(
        f"No rows with {_LEARNED}: {root / DRIVABLE_MODEL} is not there (boresight train-perception radar_drivable)"
    )
    return [row for row in ROWS if not row.spoil]


def runs_of(rows: Sequence[Row], days: Sequence[DaySpec]) -> list[Run]:
    """Every row on every day, from the same prior."""
    return [Run(d, row.method, PRIOR, d.seed, solve=row.solve, spoil=row.spoil) for row in rows for d in days]


def row_name(run: Run) -> str:
    """Name of the row that a run belongs to."""
    return next(
        row.name for row in ROWS if (row.method, row.solve, row.spoil) == (run.method, run.solve, run.spoil)
    )


def row_of(result: dict[str, Any]) -> str:
    """Row of a result line; the method where the line names none."""
    return str(result.get("row", result["method"]))


def summary(results: list[dict[str, Any]]) -> str:
    """Mean errors and their standard errors, all days, urban, highway; ratios of joint to the others; the loop."""
    parts = [errors_table(results, environment) for environment in ("", "urban", "highway")]
    return "\n\n".join([*parts, _ratios(results), _loop(results), verdicts_table(results)])


def errors_table(results: list[dict[str, Any]], environment: str, rows: Sequence[str] = NAMES) -> str:
    """Mean errors of the rows that were measured, pair by pair; `environment` is empty for all days."""
    lines = [
        f"{environment or 'All'} days, mean +- standard error over days:\n",
        f"| row | pair | days | {' | '.join(title for _, title in QUANTITIES)} |",
        "|---|---|---|" + "---|" * len(QUANTITIES),
    ]
    chosen = [r for r in results if environment in ("", r["day"]["environment"])]
    measured = [row for row in rows if any(row_of(r) == row for r in chosen)]
    for pair in PAIRS:
        for row, prefix in [*((row, "prior_") for row in measured[:1]), *((row, "") for row in measured)]:
            cells = " | ".join(cell(_values(chosen, row, pair, prefix + q)) for q, _ in QUANTITIES)
            name = "(prior)" if prefix else row
            lines.append(f"| {name} | {pair} | {_count(chosen, row, pair)} | {cells} |")
    return "\n".join(lines)


def _ratios(results: list[dict[str, Any]]) -> str:
    """Mean error of joint over that of another row, on the days that both have."""
    titles = " | ".join(title.split(" [")[0] for _, title in QUANTITIES)
    lines = ["joint over", "", f"| row | pair | {titles} |", "|---|---|" + "---|" * len(QUANTITIES)]
    for other in (n for n in NAMES[1:] if any(row_of(r) == n for r in results)):
        for pair in PAIRS:
            cells = []
            for quantity, _ in QUANTITIES:
                a, b = (_by_seed(results, row, pair, quantity) for row in ("joint", other))
                both = sorted(set(a) & set(b))
                cells.append(
                    f"{np.mean([a[s] for s in both]) / np.mean([b[s] for s in both]):.2f}" if both else "-"
                )
            lines.append(f"| {other} | {pair} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _loop(results: list[dict[str, Any]]) -> str:
    """The loop as the rows leave it, and for joint that of the estimate which never saw the lidar."""
    lines = []
    for row in NAMES:
        loops = [r["loop"] for r in results if row_of(r) == row and "loop" in r]
        if loops:
            mean = np.mean(loops, axis=0)
            lines.append(f"- {row}: loop az/el/range {mean[0]:.3f} deg / {mean[1]:.3f} deg / {mean[2]:.3f} m")
    found = [
        (p["loop_rotation_rad"], p["diagnostics"]["loop_rotation_sigma_rad"])
        for r in results
        if r["method"] == "joint"
        and (p := r["pairs"].get("camera_radar", {})).get("loop_rotation_rad") is not None
        and "loop_rotation_sigma_rad" in p.get("diagnostics", {})
    ]
    inside = share(angle <= 3 * sigma for angle, sigma in found)
    angle = np.degrees(np.mean([a for a, _ in found])) if found else float("nan")
    lines.append(
        f"- joint's loop of independent pairs (camera-radar without the lidar; zero by construction above): "
        f"mean angle {angle:.3f} deg, inside its 3 sigma {inside}"
    )
    return "\n".join(["Loops:", "", *lines])


def verdicts_table(results: list[dict[str, Any]], rows: Sequence[str] = NAMES) -> str:
    """How many records were accepted, held and refused, and what a day took."""
    lines = ["| row | accepted | held | refused | CPU s |", "|---|---|---|---|---|"]
    for row in rows:
        mine = [r for r in results if row_of(r) == row]
        if not mine:
            continue
        status = [p["status"] for r in mine for p in r["pairs"].values()]
        status += ["refused"] * sum(3 for r in mine if not r["pairs"])
        counts = " | ".join(str(status.count(s)) for s in ("accepted", "held", "refused"))
        seconds = [r["cpu_s"] for r in mine if "cpu_s" in r]
        lines.append(f"| {row} | {counts} | {np.mean(seconds) if seconds else float('nan'):.1f} |")
    return "\n".join(["Records (pairs x days):", "", *lines])


def _by_seed(results: list[dict[str, Any]], row: str, pair: str, quantity: str) -> dict[int, float]:
    return {
        r["day"]["seed"]: r["pairs"][pair][quantity]
        for r in results
        if row_of(r) == row and quantity in r["pairs"].get(pair, {})
    }


def _values(results: list[dict[str, Any]], row: str, pair: str, quantity: str) -> np.ndarray:
    return np.array(list(_by_seed(results, row, pair, quantity).values()))


def _count(results: list[dict[str, Any]], row: str, pair: str) -> int:
    return len(_by_seed(results, row, pair, "az_deg"))


def cell(values: np.ndarray) -> str:
    """Mean and standard error."""
    if not len(values):
        return "-"
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return f"{values.mean():.3f} +- {error:.3f}"


if __name__ == "__main__":
    main()
