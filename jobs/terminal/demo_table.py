"""True against estimated extrinsics, as a printed table and as numbers for the summary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from jobs.terminal.record_tables import STATUS_STYLES
from jobs.terminal.vehicle_status import status_lines
from pipeline.report.truth import Truth, true_transform
from pipeline.rig.se3 import change_between, change_covariance, inverse, rotation_angle_rad
from pipeline.store.current import current_records, prior_of, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.drift import DriftFinding

__all__ = ["errors_of", "print_comparison"]

_WIDTH = 124  # of the table; a narrower terminal wraps lines, which is easier to read than truncated names


def print_comparison(
    lake: Lake, method: str, truth: Truth, day: str, findings: Sequence[DriftFinding]
) -> None:
    """Print the records of one day next to the truth, and the findings of the audit.

    Both are shown as differences from the prior (the nominal pose): rotation vector [deg] and shift of the
    child's origin [cm], in the axes of the pair's parent sensor. An estimate in brackets is a DoF that the
    day did not determine.
    """
    found, console, table = _current(lake, method, day), Console(highlight=False), _table(day)
    console.width = max(console.width, _WIDTH)
    for record in found:
        for row in _rows(record, _true(truth, record)):
            table.add_row(*row)
    console.print(table)
    for record in (r for r in found if r.status == "refused"):
        console.print(f"{_styled(record.status)}  {record.vehicle} {_name(record)}: {record.reason}")
    for line in status_lines(findings):
        console.print(line)


def errors_of(lake: Lake, method: str, truth: Truth, day: str) -> list[dict[str, Any]]:
    """For each record of one day by a method: errors of rotation [deg] and translation [m], before and after."""
    return [_errors(r, _true(truth, r)) for r in _current(lake, method, day)]


def _true(truth: Truth, record: CalibrationRecord) -> np.ndarray:
    T = true_transform(truth, record)
    assert T is not None, "every sensor of the demo has a true pose"
    return T


def _current(lake: Lake, method: str, day: str) -> list[CalibrationRecord]:
    found = read_records(lake, CALIBRATIONS, CalibrationRecord, day=day)
    return current_records([r for r in found if r.method == method])


def _table(day: str) -> Table:
    table = Table(
        title=f"Change from the nominal pose, {day}",
        title_style="bold",
        caption="true: from the simulator. In brackets: the day did not determine it.",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for name in ("vehicle", "pair", "verdict", ""):
        table.add_column(name, no_wrap=True)
    for axis in "xyz":
        table.add_column(f"{axis} true", justify="right", no_wrap=True, style="cyan")
        table.add_column("estimate, sigma", justify="right", no_wrap=True)
    return table


def _rows(record: CalibrationRecord, T_true: np.ndarray) -> list[list[str]]:
    T, T_prior = transform_of(record), prior_of(record)
    if T is None or T_prior is None or record.covariance is None:
        return [[record.vehicle, _name(record), _styled(record.status)]]
    true, estimate = change_between(T_prior, T_true), change_between(T_prior, T)
    sigma = np.sqrt(np.diag(change_covariance(T, record.covariance)))
    seen = record.observable or [True] * 6
    rows = []
    for first, unit, scale, digits in ((0, "deg", np.degrees(1), 2), (3, "cm", 100.0, 1)):
        head = [record.vehicle, _name(record), _styled(record.status)] if first == 0 else [""] * 3
        cells = [f"turn {unit}" if first == 0 else f"shift {unit}"]
        for i in range(first, first + 3):
            shown = f"{estimate[i] * scale:+.{digits}f} ± {sigma[i] * scale:.{digits}f}"
            cells.append(f"{true[i] * scale:+.{digits}f}")
            cells.append(f"{shown} " if seen[i] else f"[dim]({shown})[/]")
        rows.append(head + cells)
    return rows


def _name(record: CalibrationRecord) -> str:
    """Both sensors, as camera_lidar if their names are their kinds."""
    return f"{record.parent_frame}_{record.child_frame}"


def _errors(record: CalibrationRecord, T_true: np.ndarray) -> dict[str, Any]:
    def error(T: np.ndarray | None) -> tuple[float | None, float | None]:
        if T is None:
            return None, None
        angle = float(np.degrees(rotation_angle_rad(T_true @ inverse(T))))
        return round(angle, 4), round(float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), 4)

    before, after = error(prior_of(record)), error(transform_of(record))
    names = ("vehicle", "day", "method", "pair", "parent_frame", "child_frame", "status")
    return {name: getattr(record, name) for name in names} | {
        "rotation_error_prior_deg": before[0],
        "rotation_error_deg": after[0],
        "translation_error_prior_m": before[1],
        "translation_error_m": after[1],
    }


def _styled(status: str) -> str:
    return f"[{STATUS_STYLES[status]}]{status}[/]"
