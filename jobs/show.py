"""`boresight show`: what a lake holds, for people and for machines."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from pipeline.store.partitions import Lake

__all__ = ["show"]

_PIPE_WIDTH = 200
Table = Literal["calibrations", "drift", "frames", "observations"]


def show(
    table: Table,
    *,
    lake: str,
    vehicle: str | None = None,
    day: str | None = None,
    method: str | None = None,
    current: bool = False,
    json: bool = False,
) -> int:
    """Show records (calibrations, drift) or partitions (frames, observations).

    Args:
        table: what to show.
        lake: folder of the tables.
        vehicle: only this vehicle.
        day: only this day, YYYY-MM-DD.
        method: only records of this method.
        current: only the last record of each vehicle, day, method and pair.
        json: print a JSON list and nothing else: oldest record first, names as the columns, and for
            calibrations "T", the 4x4 row-major T_parent_child (null where the day was refused).
    """
    from pipeline.store.partitions import Lake

    tables = Lake.at(lake)
    if table in ("frames", "observations"):
        rows = _partitions(tables, table, vehicle, day)
    else:
        rows = _records(tables, table, vehicle, day, method, current=current)
    if json:
        from jobs.terminal.summary import print_json

        print_json(rows, indent=2)
    elif rows:
        _print_table(table, rows)
    else:
        sys.stdout.write(f"{table}: nothing of this choice in {lake}\n")
    return 0


def _records(
    lake: Lake, table: Table, vehicle: str | None, day: str | None, method: str | None, *, current: bool
) -> list[dict[str, Any]]:
    from pipeline.store.current import current_drift, current_records, transform_of
    from pipeline.store.tables import read_records
    from schemas.calibrations import CALIBRATIONS, CalibrationRecord
    from schemas.drift import DRIFT, DriftFinding

    if table == "calibrations":
        records = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day)
        records = [r for r in records if method in (None, r.method)]
        chosen = current_records(records) if current else records
        names = [c.name for c in CALIBRATIONS.columns]
        return [{n: getattr(r, n) for n in names} | {"T": transform_of(r)} for r in chosen]
    findings = read_records(lake, DRIFT, DriftFinding, vehicle=vehicle, day=day)
    findings = [f for f in findings if method in (None, f.method)]
    kept = current_drift(findings) if current else findings
    return [{c.name: getattr(f, c.name) for c in DRIFT.columns} for f in kept]


def _partitions(lake: Lake, table: Table, vehicle: str | None, day: str | None) -> list[dict[str, Any]]:
    from dataclasses import asdict

    from pipeline.store.tables import read_manifest
    from schemas.versions import TABLES

    rows = []
    for partition in lake.partitions(table):
        if vehicle in (None, partition.vehicle) and day in (None, partition.day):
            manifest = read_manifest(lake, TABLES[table], partition)
            if manifest is not None:
                rows.append({"vehicle": partition.vehicle, "day": partition.day} | asdict(manifest))
    return rows


def _print_table(table: Table, rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable

    cells = {"calibrations": _calibration_cells, "drift": _drift_cells}.get(table, _partition_cells)
    lines = [cells(row) for row in rows]
    view = RichTable(title=f"{table}: {len(rows)} row{'' if len(rows) == 1 else 's'}", title_justify="left")
    for name in lines[0]:
        # Numbers and names never break; only the words at the end of a line may.
        view.add_column(name, no_wrap=name not in ("reason", "rejected"))
    colours = {"accepted": "green", "held": "yellow", "refused": "red"}
    colours |= {"GREEN": "green", "YELLOW": "yellow", "RED": "red", "UNKNOWN": "dim"}
    for line in lines:
        view.add_row(*(f"[{colours[c]}]{c}[/]" if c in colours else c for c in line.values()))
    # Into a pipe or file nothing needs to fit a window.
    Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH).print(view)


def _calibration_cells(row: dict[str, Any]) -> dict[str, str]:
    import numpy as np

    sigma = np.full(6, np.nan) if row["covariance"] is None else np.sqrt(np.diag(row["covariance"]))
    seen = row["observable"] or [False] * 6
    degrees = " ".join(_sigma(s, o, 3) for s, o in zip(np.degrees(sigma[:3]), seen[:3], strict=True))
    metres = " ".join(_sigma(s, o, 3) for s, o in zip(sigma[3:], seen[3:], strict=True))
    return {
        "vehicle": row["vehicle"],
        "day": row["day"],
        "method": row["method"],
        "pair": row["pair"],
        "status": row["status"],
        "sigma rx ry rz [deg]": degrees,
        "sigma tx ty tz [m]": metres,
        "frames": str(row["frames_used"]),
        "reason": row["reason"],
    }


def _sigma(sigma: float, observable: bool, digits: int) -> str:
    return f"{sigma:.{digits}f}" if observable else "  -  "


def _drift_cells(row: dict[str, Any]) -> dict[str, str]:
    import math

    is_rotation = row["dof"].startswith("r")
    scale, unit = (180 / math.pi, "deg") if is_rotation else (1.0, "m")
    size = ""
    if row["magnitude"] is not None:
        size = f"{row['magnitude'] * scale:+.3f} ± {row['magnitude_sigma'] * scale:.3f} {unit}"
    return {
        "vehicle": row["vehicle"],
        "day": row["day"],
        "pair": row["pair"],
        "dof": row["dof"],
        "status": row["status"],
        "change": size,
        "limit": f"{row['limit'] * scale:.3g} {unit}",
        "since": row["start_day"] or "",
        "moved": row["moved_sensor"] or "",
        "reason": row["reason"],
    }


def _partition_cells(row: dict[str, Any]) -> dict[str, str]:
    counts = ", ".join(f"{count} {why}" for why, count in row["rejected"].items())
    return {
        "vehicle": row["vehicle"],
        "day": row["day"],
        "rows": str(row["rows"]),
        "work key": row["work_key"],
        "rejected": counts,
    }
