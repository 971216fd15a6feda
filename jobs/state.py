"""`boresight state`: the calibration that each vehicle should load tonight."""

from __future__ import annotations

import sys

__all__ = ["state"]


def state(*, lake: str, vehicle: str | None = None, method: str = "joint", json: bool = False) -> int:
    """Show what each vehicle should load tonight: mean of accepted days since the last change, with sigma.

    A rig that is adjusted as a whole has a line per sensor (its pose relative to the reference), other rigs
    one per pair.

    `boresight nightly` and `boresight audit` write the table states; this command prints its latest rows.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: calibration method.
        json: print only a JSON list: keys as the columns of table states, and "T" and "T_prior": the 4x4
            row-major T_parent_child and its prior on the last day (null if there is none). Contains rows of
            sensors (`sensor` is not null) and rows of the pairs that their poses are computed from.
    """
    from jobs.terminal.state_rows import state_rows
    from jobs.terminal.summary import left_out, print_json
    from pipeline.store.current import current_states
    from pipeline.store.partitions import Lake
    from pipeline.store.records import read_records
    from schemas.states import STATES, StateRow

    tables = Lake.existing(lake)
    found = [r for r in read_records(tables, STATES, StateRow, vehicle=vehicle) if r.method == method]
    rows = state_rows(tables, current_states(found))
    if json:
        print_json(rows, indent=2)
    elif rows:
        from jobs.terminal.record_tables import print_table

        by_sensor = {row["vehicle"] for row in rows if row["sensor"] is not None}
        print_table("states", [r for r in rows if r["sensor"] is not None or r["vehicle"] not in by_sensor])
    else:
        sys.stdout.write(f"states: none in {lake}; boresight nightly and boresight audit write them\n")
    return 3 if left_out(tables) else 0
