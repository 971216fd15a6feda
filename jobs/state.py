"""`boresight state`: what each vehicle should load tonight."""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["state"]


def state(*, lake: str, vehicle: str | None = None, method: str = "joint", json: bool = False) -> int:
    """Show what each vehicle should load tonight: its accepted days since the last change, fused, with sigma.

    The night and `boresight audit` write it (table states); this prints the latest.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: of the calibrations.
        json: print a JSON list and nothing else: names as the columns of table states, and "T", the 4x4 row-major
            T_parent_child (null where there is no accepted day).
    """
    from jobs.terminal.summary import left_out, print_json
    from pipeline.store.current import current_states, transform_of
    from pipeline.store.partitions import Lake
    from pipeline.store.records import read_records
    from schemas.states import STATES, StateRow

    tables = Lake.existing(lake)
    found = [r for r in read_records(tables, STATES, StateRow, vehicle=vehicle) if r.method == method]
    left_out(tables)
    names = [c.name for c in STATES.columns]
    rows: list[dict[str, Any]] = [
        {n: getattr(r, n) for n in names} | {"T": transform_of(r)} for r in current_states(found)
    ]
    if json:
        print_json(rows, indent=2)
    elif rows:
        from jobs.terminal.record_tables import print_table

        print_table("states", rows)
    else:
        sys.stdout.write(f"states: none in {lake}; boresight nightly and boresight audit write them\n")
    return 0
