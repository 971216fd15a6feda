"""`boresight show`: rows of a lake's tables, for people or as JSON."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Literal

from jobs.state import state_text
from jobs.terminal.record_tables import print_table
from jobs.terminal.summary import left_out, print_json
from pipeline.core.errors import ContractError
from pipeline.store.current import (
    current_drift,
    current_events,
    current_poses,
    current_records,
    current_states,
    state_values,
    transform_of,
)
from pipeline.store.partitions import Lake
from pipeline.store.records import Assertion, last_assertion, read_records
from pipeline.store.tables import read_manifest
from schemas.versions import TABLES

__all__ = ["show"]

_CURRENT: dict[str, Callable[[list[Any]], list[Any]]] = {
    "calibrations": current_records,
    "poses": current_poses,
    "drift": current_drift,
    "states": current_states,
    "service_events": current_events,
}
Table = Literal[
    "calibrations",
    "poses",
    "drift",
    "states",
    "outcomes",
    "service_events",
    "sign_offs",
    "moments",
    "perceived",
]


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
    """Show records (calibrations, poses, drift, states, ...) or partitions (moments, perceived).

    Args:
        table: table to show.
        lake: folder of the tables.
        vehicle: only this vehicle.
        day: only this day, YYYY-MM-DD.
        method: only records of this method.
        current: only the current record of each vehicle, day, method and edge or sensor; for drift, findings
            of the last audit; for service_events, events that were not withdrawn; for outcomes, all rows.
        json: print only a JSON list: oldest record first, keys as the columns. Calibrations have "T" too, the
            4x4 row-major T_parent_child; poses have T_reference_sensor (null if refused).
    """
    tables = Lake.existing(lake)
    if table in ("moments", "perceived"):
        rows = _partitions(tables, table, vehicle, day)
    else:
        rows = _records(tables, table, vehicle, day, method, current=current)
    if json:
        print_json(rows, indent=2)
    elif rows and table == "states":
        sys.stdout.write(state_text(rows))
    elif rows:
        print_table(table, rows)
    else:
        sys.stdout.write(f"{table}: no matching rows in {lake}\n")
    return 3 if left_out(tables) else 0


def _records(
    lake: Lake, table: Table, vehicle: str | None, day: str | None, method: str | None, *, current: bool
) -> list[dict[str, Any]]:
    schema = TABLES[table]
    rows: list[Any] = read_records(lake, schema, schema.row_type, vehicle=vehicle, day=day)
    rows = [r for r in rows if method in (None, getattr(r, "method", None))]
    if current and table in _CURRENT:
        rows = _CURRENT[table](rows)
    if current and table == "drift":  # what the last audit left out is not current
        last = {last_assertion(lake, schema, m) for m in {r.method for r in rows}}
        rows = [r for r in rows if Assertion(r.asserted_at, r.day, r.method) in last]
    if table == "states":
        return state_values(rows)
    with_T = table in ("calibrations", "poses")
    return [
        {c.name: getattr(r, c.name) for c in schema.columns} | ({"T": transform_of(r)} if with_T else {})
        for r in rows
    ]


def _partitions(lake: Lake, table: Table, vehicle: str | None, day: str | None) -> list[dict[str, Any]]:
    rows = []
    for partition in lake.partitions(table):
        if vehicle in (None, partition.vehicle) and day in (None, partition.day):
            try:
                manifest = read_manifest(lake, TABLES[table], partition)
            except ContractError as err:
                lake.damage.append(str(err))
                continue
            if manifest is not None:
                rows.append({"vehicle": partition.vehicle, "day": partition.day} | asdict(manifest))
    return rows
