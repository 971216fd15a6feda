"""Rows of a lake's tables as text: one line each, numbers in degrees and metres, statuses in colour."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipeline.rig.graph import POSE, edge_named, pose_of, words_of
from pipeline.rig.se3 import change_between, to_quaternion
from schemas.faults import in_words

__all__ = ["STATUS_STYLES", "numbers", "print_table"]

STATUS_STYLES = {
    "accepted": "green",
    "held": "yellow",
    "refused": "red",
    "GREEN": "green",
    "YELLOW": "yellow",
    "RED": "bold red",
    "UNKNOWN": "dim",
}
_PIPE_WIDTH = 280  # characters; output to a pipe or file need not fit a window


def print_table(table: str, rows: list[dict[str, Any]]) -> None:
    """Print at least one row of a table, with its columns as headings."""
    known: dict[str, Callable[[dict[str, Any]], dict[str, str]]] = {
        "calibrations": _calibration_cells,
        "poses": _pose_row_cells,
        "drift": _drift_cells,
        "outcomes": _outcome_cells,
        "service_events": lambda row: (
            _named(row, "vehicle", "day", "sensor", "kind", "note")
            | {"withdrawn": "yes" if row["withdrawn"] else ""}
        ),
        "sign_offs": lambda row: _named(row, "vehicle", "day", "method", "signed_by", "asserted_at", "note"),
    }
    lines = [known.get(table, _partition_cells)(row) for row in rows]
    view = Table(title=f"{table}: {len(rows)} row{'' if len(rows) == 1 else 's'}", title_justify="left")
    for name in lines[0]:
        # Only the text at the end of a line may wrap, never numbers and names.
        view.add_column(Text(name), no_wrap=name not in ("reason", "rejected"))
    for line in lines:
        # Text instead of str: names from logs may contain square brackets, which rich would read as styles.
        view.add_row(*(Text(c, STATUS_STYLES.get(c, "")) for c in line.values()))
    Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH).print(view)


def _calibration_cells(row: dict[str, Any]) -> dict[str, str]:
    sigma = np.full(6, np.nan) if row["covariance"] is None else np.sqrt(np.diag(row["covariance"]))
    seen = row["observable"] or [False] * 6
    sigma[:3] = np.degrees(sigma[:3])
    shown = [f"{s:.3f}" if is_seen else "  -  " for s, is_seen in zip(sigma, seen, strict=True)]
    return {
        **_named(row, "vehicle", "day", "method"),
        "pair": _edge(row),
        "status": row["status"],
        "qw qx qy qz, x y z": _pose(row["T"]),
        "change from prior": _change(row["T"], pose_of(row.__getitem__, "prior_")),
        "sigma [deg, m]": f"{' '.join(shown[:3])} deg\n{' '.join(shown[3:])} m",
        "frames": str(row["frames_used"]),
        "certified": ", ".join(row["determined"]),
        "of the mounting": ", ".join(row["mounting_determined"]),
        "reason": _reason(row),
    }


def _pose_row_cells(row: dict[str, Any]) -> dict[str, str]:
    sigmas = (row["azimuth_sigma_rad"], row["elevation_sigma_rad"])
    azimuth, elevation = ("" if s is None else f"{s * 180 / math.pi:.3f}" for s in sigmas)
    return {
        **_named(row, "vehicle", "day", "method", "sensor", "reference", "status"),
        "qw qx qy qz, x y z": _pose(row["T"]),
        "sigma azimuth [deg]": azimuth,
        "elevation [deg]": elevation,
        "certified": ", ".join(row["determined"]),
        "edges": ", ".join(row["edges"]),
        "reason": _reason(row),
    }


def _pose(T: Any) -> str:
    return "" if T is None else f"{numbers(to_quaternion(T), '.5f')}\n{numbers(T[:3, 3], '.3f')} m"


def _change(T: Any, T_prior: Any) -> str:
    """Change from the prior, along the parent's axes."""
    if T is None or T_prior is None:
        return ""
    change = change_between(T_prior, T)
    return f"{numbers(np.degrees(change[:3]), '+.3f')} deg\n{numbers(change[3:], '+.3f')} m"


def numbers(values: Any, form: str) -> str:
    """Numbers in one line, each in the form."""
    return " ".join(f"{value:{form}}" for value in values)


def _reason(row: dict[str, Any]) -> str:
    return "; ".join(text for text in (in_words(row["faults"] or ()), row["reason"]) if text)


def _drift_cells(row: dict[str, Any]) -> dict[str, str]:
    is_rotation = row["dof"].startswith("r")
    scale, unit = (180 / math.pi, "deg") if is_rotation else (1.0, "m")
    size = ""
    if row["magnitude"] is not None:
        size = f"{row['magnitude'] * scale:+.3f} ± {row['magnitude_sigma'] * scale:.3f} {unit}"
    return {
        "vehicle": row["vehicle"],
        "vehicle is": row["vehicle_status"] or "",
        "day": row["day"],
        "pair": _edge(row),
        "dof": row["dof"],
        "chart": row["status"],
        "change": size,
        "limit": f"{row['limit'] * scale:.3g} {unit}",
        "since": row["start_day"] or "",
        "moved": row["moved_sensor"] or "",
        "reason": row["reason"],
    }


def _outcome_cells(row: dict[str, Any]) -> dict[str, str]:
    return {
        **_named(row, "vehicle", "day", "stage", "method", "status"),
        "began": row["began_at"],
        "seconds": f"{row['seconds']:.1f}",
        "rows": str(row["rows"]),
        "reason": row["reason"],
    }


def _partition_cells(row: dict[str, Any]) -> dict[str, str]:
    counts = ", ".join(f"{count} {why}" for why, count in row["rejected"].items())
    told = {"rows": str(row["rows"]), "work key": row["work_key"], "rejected": counts}
    return _named(row, "vehicle", "day") | told


def _named(row: dict[str, Any], *names: str) -> dict[str, str]:
    return {name: row[name] for name in names}


def _edge(row: dict[str, Any]) -> str:
    """Kinds of the two sensors, or their names if they differ from the kinds, as in `words_of`."""
    if row["pair"] == POSE:
        return f"{row['child_frame']} in {row['parent_frame']}"
    return words_of(edge_named(row["pair"], row["parent_frame"], row["child_frame"]))
