"""Text with the alignment stated by radars next to the day's calibration."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping
from typing import Any

from pipeline.report.words import scaled

__all__ = ["alignment_lines"]


def alignment_lines(row: Mapping[str, Any]) -> list[dict[str, str]]:
    """A line for each axis that a row of table `radar_alignments` states, cells by their headings."""
    first, last = (_clock(row[f"{end}_stamp_ns"]) for end in ("first", "last"))
    lines = []
    for axis in ("azimuth", "elevation"):
        if row[f"{axis}_rad"] is None:
            continue
        sigma = row[f"{axis}_sigma_rad"]
        stated = _angle(row[f"{axis}_rad"], sigma) + ("" if sigma is not None else " (no sigma stated)")
        step = row[f"{axis}_step_rad"]
        found = _angle(row[f"own_{axis}_rad"], row[f"own_{axis}_sigma_rad"])
        lines.append(
            {
                "radar": row["sensor"],
                "axis": axis,
                "it states": stated,
                "its messages scatter by": _angle(row[f"{axis}_scatter_rad"], None).removeprefix("+"),
                "calibrated": f"{found} ({row['own_edge']})" if found else "",
                "step within the day": f"{_angle(step, None)}, at {_clock(row['step_stamp_ns'])}"
                if step
                else "",
                "messages": f"{row['messages']}, {first} to {last} UTC",
            }
        )
    return lines


def _angle(angle_rad: float | None, sigma_rad: float | None) -> str:
    """As `+0.31 ± 0.05 deg`; empty if there is none."""
    if angle_rad is None:
        return ""
    sigma = "" if sigma_rad is None else f" ± {scaled(sigma_rad, 'rx'):.3f}"
    return f"{scaled(angle_rad, 'rx'):+.3f}{sigma} deg"


def _clock(stamp_ns: int) -> str:
    return f"{dt.datetime.fromtimestamp(stamp_ns * 1e-9, dt.UTC):%H:%M}"
