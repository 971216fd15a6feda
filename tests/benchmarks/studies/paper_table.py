"""The paper's Table 1 and extended data table 1 in its own columns, closed loop included, from lines measured before.

    python -m tests.benchmarks.studies.paper_table > tests/benchmarks/results/table1_paper.md

Nothing is calibrated: rows are means over the days that `table1.py` and `ssl_table1.py` measured (ten days of seeds
3200 to 3209, the same for all rows). The paper's printed rows stand below ours: other sensors, other roads. The loop is
lidar to camera to radar and back, at the same targets; of methods that close it by construction it says nothing, and of
`joint` the loop of the pairs estimated apart stands in the table of records.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.evaluate.table import TableRow, table_rows
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.table1 import NAMES

__all__ = ["paper_table", "values_of"]

FILES = ("table1_040.jsonl", "ssl_table1.jsonl")
_NETWORK, _POLISHED = "joint-ssl (matching)", "joint-ssl (matching) + polish"
ROWS = (*NAMES, _NETWORK, _POLISHED)
# Row of ours -> the printed row that stands below it.
_PRINTED = {
    "tracking": "paper: object tracking [60]",
    "pairwise-optimisation, learned drivable areas": "paper: pairwise optimization",
    "joint-optimisation, equation 2 to the letter, learned drivable areas": "paper: joint optimization",
    _POLISHED: "paper: joint SSL",
}
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
