"""Table 1 and extended data table 1 of the paper: our rows next to the printed ones, in Markdown or Parquet.

The printed rows come from other sensors on other roads ("other data"). They show the meaning and the order of
magnitude of the rows; the table is not a ranking. Methods without a record have a row with dashes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.rig.targets import Comparison
from schemas.calibrations import METHODS, PAIRS

__all__ = ["TableRow", "as_markdown", "as_parquet", "table_rows"]

COLUMNS = (
    "camera_lidar_azimuth_deg",
    "camera_lidar_elevation_deg",
    "camera_radar_azimuth_deg",
    "camera_radar_elevation_deg",
    "lidar_radar_azimuth_deg",
    "lidar_radar_elevation_deg",
    "lidar_radar_range_m",
    "loop_azimuth_deg",
    "loop_elevation_deg",
    "loop_range_m",
)
_KINDS = {
    **dict.fromkeys(("table", "method", "environment", "source"), pa.string()),
    **dict.fromkeys(("runs", "accepted_pairs", "pairs"), pa.int64()),
    **dict.fromkeys(("independent_loop_deg", "independent_loop_m"), pa.float64()),
}
_TABLES = {"all": "Table 1", "highway": "Extended data table 1", "urban": "Extended data table 1"}
_NAN = float("nan")
_CLOSED = 1e-6  # degrees or metres: rounding of stored quaternions
# Method, environment, name printed in the paper, COLUMNS. Camera pairs have no range in the paper either.
_PAPER: tuple[tuple[str, str, str, tuple[float, ...]], ...] = (
    ("tracking", "all", "object tracking [60]", (0.55, 2.01, 1.92, 3.13, 1.46, 1.87, 0.22, _NAN, _NAN, _NAN)),
    (
        "pairwise-optimisation",
        "all",
        "pairwise optimization",
        (0.21, 0.28, 0.20, 0.44, 0.97, 0.21, 0.14, 1.43, 0.83, 0.01),
    ),
    (
        "joint-optimisation",
        "all",
        "joint optimization",
        (0.22, 0.27, 0.20, 0.45, 0.36, 0.72, 0.14, 0.09, 0.01, 0.01),
    ),
    ("pairwise-ssl", "all", "pairwise SSL", (0.07, 0.09, 1.36, 0.29, 1.17, 1.09, 0.30, 0.14, 0.61, 0.01)),
    ("joint-ssl", "all", "joint SSL", (0.08, 0.20, 0.02, 0.14, 0.51, 0.61, 0.13, 0.02, 0.02, 0.01)),
    (
        "joint-optimisation",
        "highway",
        "joint optimization",
        (0.42, 0.65, 0.08, 0.60, 0.31, 1.17, 0.13, 0.17, 0.02, 0.01),
    ),
    ("joint-ssl", "highway", "joint SSL", (0.01, 0.22, 0.09, 0.08, 0.49, 0.66, 0.14, 0.06, 0.03, 0.07)),
    (
        "joint-optimisation",
        "urban",
        "joint optimization",
        (0.13, 0.21, 0.13, 0.49, 0.02, 0.69, 0.13, 0.06, 0.01, 0.01),
    ),
    ("joint-ssl", "urban", "joint SSL", (0.10, 0.18, 0.03, 0.37, 0.51, 0.61, 0.13, 0.03, 0.04, 0.04)),
)


@dataclass(frozen=True)
class TableRow:
    """One line of the tables."""

    table: str
    method: str
    environment: str
    source: str  # ours, or paper (other data)
    runs: int | None
    values: tuple[float, ...]  # COLUMNS, NaN = no value
    accepted_pairs: int | None = None
    pairs: int | None = None
    # Loop of independently estimated pairs: a check for methods that close the loop by construction.
    independent_loop_deg: float | None = None
    independent_loop_m: float | None = None


def table_rows(comparisons: Sequence[Comparison]) -> list[TableRow]:
    """All rows: the prior, the uncertainty of the truth, then each method with the paper's row below ours.

    A row is the mean of absolute errors over runs (and reflectors), as in the paper; environment "all"
    includes every run, highway and urban only runs whose drives were all of that kind.
    """
    references = {
        "(prior)": [c.prior_errors for c in comparisons],
        "(truth: spread of one frame's pick)": [c.truth_spread for c in comparisons if c.truth_spread],
        "(truth: 1 sigma of the positions)": [c.truth_sigma for c in comparisons if c.truth_sigma],
    }
    rows = [
        TableRow("Table 1", name, "all", "ours", len(errors), _values(errors))
        for name, errors in references.items()
        if errors
    ]
    for environment, table in _TABLES.items():
        printed = {method: (name, values) for method, env, name, values in _PAPER if env == environment}
        for method in METHODS:
            members = [c for c in comparisons if c.method == method and environment in ("all", c.environment)]
            rows.append(_our_row(table, method, environment, members))
            if method in printed:
                name, values = printed[method]
                rows.append(
                    TableRow(table, f"paper: {name}", environment, "paper (other data)", None, values)
                )
    return rows


def as_markdown(
    rows: Sequence[TableRow], comparisons: Sequence[Comparison], notes: Sequence[str] = ()
) -> dict[str, str]:
    """Markdown of each table by title; below Table 1, the calibration of the sigmas and the notes."""
    texts = {}
    for title in dict.fromkeys(_TABLES.values()):
        lines = [f"## {title}", "", *_HEADER, *(_line(r) for r in rows if r.table == title), ""]
        if title == "Table 1":
            remarks = [*notes, *_loop_remarks(rows)]
            lines += [*(f"- {remark}" for remark in remarks), ""] if remarks else []
            lines += [*_honesty(comparisons), ""]
        texts[title] = "\n".join(lines).rstrip() + "\n"
    return texts


def as_parquet(rows: Sequence[TableRow], notes: Sequence[str] = ()) -> bytes:
    """The rows as one Parquet file: degrees and metres, null for a dash, notes in the footer."""
    arrays = {n: pa.array([getattr(r, n) for r in rows], kind) for n, kind in _KINDS.items()}
    for k, column in enumerate(COLUMNS):
        arrays[column] = pa.array([r.values[k] for r in rows], pa.float64(), from_pandas=True)
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(arrays).replace_schema_metadata({"truth": "\n".join(notes)}), sink)
    return sink.getvalue().to_pybytes()


_HEADER = (
    (
        "| method | environment | runs | camera-lidar az/el [deg] | camera-radar az/el [deg] "
        "| lidar-radar az/el [deg] / range [m] | loop az/el [deg] / range [m] | accepted |"
    ),
    "|---|---|---|---|---|---|---|---|",
)


def _our_row(table: str, method: str, environment: str, members: Sequence[Comparison]) -> TableRow:
    if not members:
        return TableRow(table, method, environment, "ours", 0, (_NAN,) * len(COLUMNS))
    accepted = sum(s == "accepted" for c in members for s in c.statuses.values())
    loops = [c.independent_loop for c in members if c.independent_loop is not None]
    shifts = [shift for _, shift in loops if shift is not None]
    return TableRow(
        table, method, environment, "ours", len(members), _values([c.errors for c in members]), accepted,
        len(PAIRS) * len(members),
        float(np.degrees(np.mean([angle for angle, _ in loops]))) if loops else None,
        float(np.mean(shifts)) if shifts else None,
    )  # fmt: skip


def _loop_remarks(rows: Sequence[TableRow]) -> list[str]:
    """Notes on methods that close the loop by construction: the loop of their independent pair estimates."""
    return [
        f"{r.method} closes the loop by construction; loop of its independent pairs: {_apart(r)}"
        for r in rows
        if r.source == "ours" and r.pairs and r.environment == "all" and max(r.values[7:]) < _CLOSED
    ]


def _apart(row: TableRow) -> str:
    if row.independent_loop_deg is None:
        return "not known"
    if row.independent_loop_m is None:
        return f"{row.independent_loop_deg:.3f} deg, over rotations only"
    return f"{row.independent_loop_deg:.3f} deg, {row.independent_loop_m:.3f} m"


def _values(errors: Sequence[Mapping[str, np.ndarray]]) -> tuple[float, ...]:
    of = {name: np.mean([e[name] for e in errors], axis=0) for name in (*PAIRS, "loop")}
    degrees = {name: [*np.degrees(e[:2]).tolist(), float(e[2])] for name, e in of.items()}
    cameras = (*degrees["camera_lidar"][:2], *degrees["camera_radar"][:2])
    return (*cameras, *degrees["lidar_radar"], *degrees["loop"])


def _line(row: TableRow) -> str:
    v = row.values
    digits = 3 if row.source == "ours" else 2  # number of digits printed in the paper
    cells = " | ".join(_join(part, digits) for part in (v[:2], v[2:4], v[4:7], v[7:]))
    runs = "other data" if row.runs is None else str(row.runs)
    share = f"{row.accepted_pairs} of {row.pairs} pairs" if row.pairs else ""
    return f"| {row.method} | {row.environment} | {runs} | {cells} | {share} |"


def _join(values: Sequence[float], digits: int) -> str:
    if np.all(np.isnan(values)):
        return "-"
    return " / ".join("-" if np.isnan(v) else f"{v:.{digits}f}" for v in values)


def _honesty(comparisons: Sequence[Comparison]) -> list[str]:
    lines: list[str] = []
    for method in METHODS:
        parts = [c.normalised for c in comparisons if c.method == method]
        z = np.abs(np.concatenate(parts)) if parts else np.zeros(0)
        if not len(z):
            continue
        if not lines:
            lines = [
                "| method | observable DoF | within 1 sigma | within 3 sigma | RMS of error/sigma |",
                "|---|---|---|---|---|",
            ]
        within = f"{np.mean(z < 1):.0%} | {np.mean(z < 3):.0%} | {np.sqrt(np.mean(z**2)):.2f}"
        lines.append(f"| {method} | {len(z)} | {within} |")
    return lines
