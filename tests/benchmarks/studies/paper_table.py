"""The paper's Table 1 and extended data table 1 in its own columns, closed loop included, from lines measured before.

    python -m tests.benchmarks.studies.paper_table > tests/benchmarks/results/table1_paper.md

Nothing is calibrated: rows are means over the days that `table1.py` and `ssl_table1.py` measured (ten days of seeds
3200 to 3209, the same for all rows). The paper's printed rows stand below ours: other sensors, other roads. The loop is
lidar to camera to radar and back, at the same targets; of methods that close it by construction it says nothing, and of
`joint` the loop of the pairs estimated apart stands in the table of records.

Networks trained on the paper's own loss (`paper_ssl.py`) stand in a table of their own, with the share of the paper's
samples that they saw: their days are others, of vehicles that they did not learn from (`ssl_table1.py --tuning`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.evaluate.table import TableRow, table_rows
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.engine import RESULTS, read_results
from tests.benchmarks.studies.paper_ssl import PAPER_SAMPLES
from tests.benchmarks.studies.ssl_tables import frame_values
from tests.benchmarks.studies.table1 import NAMES

__all__ = ["paper_table", "values_of"]

FILES = ("table1_040.jsonl", "ssl_table1_070.jsonl")
_NETWORK, _POLISHED = "joint-ssl (matching)", "joint-ssl (matching) + polish"
ROWS = (*NAMES, _NETWORK, _POLISHED)
# Row of ours -> the printed row that stands below it.
_PRINTED = {
    "tracking": "paper: object tracking [60]",
    "pairwise-optimisation, learned drivable areas": "paper: pairwise optimization",
    "joint-optimisation, equation 2 to the letter, learned drivable areas": "paper: joint optimization",
    _POLISHED: "paper: joint SSL",
}
OWN = "paper_ssl_days.jsonl"
OWN_ROWS = {"pairwise-ssl": "paper: pairwise SSL", "joint-ssl (paper's training)": "paper: joint SSL"}
_CLOSED = 5e-4  # below what is printed: the method closes the loop itself
_HEADER = (
    "| row | days | camera-lidar az | el | camera-radar az | el | lidar-radar az | el | range | loop az | el | range |",
    "|---|" + "---|" * 11,
)


def main() -> None:
    """Print the tables."""
    results = [json.loads(line) for name in FILES for line in (Path(RESULTS) / name).read_text().splitlines()]
    print(
        "Recomputed from", " and ".join(FILES), "(degrees and metres; means over days of absolute errors)\n"
    )
    for title, environment in (
        ("Table 1", ""),
        *(("Extended data table 1", e) for e in ("highway", "urban")),
    ):
        print(paper_table(results, title, environment), end="\n\n")
    runs = json.loads((Path(RESULTS) / "paper_ssl.json").read_text())["runs"]
    print(own_table(read_results(Path(RESULTS) / OWN), runs))


def own_table(results: Sequence[dict[str, Any]], runs: Mapping[str, dict[str, Any]]) -> str:
    """The paper's SSL on the paper's loss: one frame as the paper answers it, and a day as our product takes it."""
    printed = {r.method: r for r in table_rows([]) if r.environment == "all"}
    seen = ", ".join(f"{name} {run['samples'] / PAPER_SAMPLES:.2%}" for name, run in runs.items())
    lines = [
        "The paper's SSL on its own loss, other days than above, after a share of its samples:",
        seen,
        "",
    ]
    lines += _HEADER
    for row, below in OWN_ROWS.items():
        frames = [r for r in results if r["part"] == "frames" and r["method"] == row]
        days = values_of([r for r in results if r["part"] == "days"], row, "")
        if not frames or not len(days):
            continue  # not measured
        for what, name in (("started from", "prior"), ("one frame, one pass", "errors")):
            found = [frame_values(frames, row, "prior", pair, name) for pair in PAIRS]
            first = np.hstack([v if v.ndim == 2 else v[:, 0] for v in found])[:, [0, 1, 3, 4, 6, 7, 8]]
            told = [*(f"{v:.3f}" for v in first.mean(axis=0)), "-", "-", "-"]
            lines.append(f"| {row}, {what} | {len(frames)} | {' | '.join(told)} |")
        told = [f"{v:.3f}" for v in days.mean(axis=0)]
        lines.append(f"| {row}, a day by our product, three passes | {len(days)} | {' | '.join(told)} |")
        lines.append(_paper_line(printed[below]))
    return "\n".join(lines)


def paper_table(results: Sequence[dict[str, Any]], title: str, environment: str) -> str:
    """One table: our rows, the paper's below those that are the same method; `environment` empty = all days."""
    printed = {r.method: r for r in table_rows([]) if r.environment == (environment or "all")}
    lines = [f"{title}, {environment or 'all'} days:", "", *_HEADER]
    for row in ROWS:
        values = values_of(results, row, environment)
        if not len(values):
            continue  # not measured
        means = values.mean(axis=0)
        told = [f"{v:.3f}" for v in means[:7]]
        told += ["closed"] * 3 if np.all(means[7:] < _CLOSED) else [f"{v:.3f}" for v in means[7:]]
        lines.append(f"| {row} | {len(values)} | {' | '.join(told)} |")
        if _PRINTED.get(row) in printed:
            lines.append(_paper_line(printed[_PRINTED[row]]))
    return "\n".join(lines)


def values_of(results: Sequence[dict[str, Any]], row: str, environment: str) -> np.ndarray:
    """The ten columns of every day of a row that has all three pairs."""
    found = []
    for result in results:
        if result.get("row", result["method"]) != row:
            continue
        if environment not in ("", result["day"]["environment"]) or not _is_whole(result):
            continue
        pairs = result["pairs"]
        columns = [pairs[p][q] for p in ("camera_lidar", "camera_radar") for q in ("az_deg", "el_deg")]
        columns += [pairs["lidar_radar"][q] for q in ("az_deg", "el_deg", "range_m")]
        found.append([*columns, *result["loop"]])
    return np.array(found).reshape(-1, 10)


def _is_whole(result: dict[str, Any]) -> bool:
    return (
        "loop" in result
        and all("az_deg" in p for p in result["pairs"].values())
        and len(result["pairs"]) == 3
    )


def _paper_line(row: TableRow) -> str:
    told = ["-" if np.isnan(v) else f"{v:.2f}" for v in row.values]
    return f"| *{row.method} (other data)* | | {' | '.join(f'*{v}*' for v in told)} |"


if __name__ == "__main__":
    main()
