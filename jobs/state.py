"""`boresight state`: the calibration that each vehicle should load tonight."""

from __future__ import annotations

import sys

__all__ = ["state"]


def state(*, lake: str, vehicle: str | None = None, method: str = "joint", json: bool = False) -> int:
    """Show what each vehicle should load tonight: a pose per sensor relative to the reference, with sigma.

    The days since a sensor last moved determine its pose; without such days it is at the prior. The sigma is that of
    tomorrow's drive.

    `boresight nightly` and `boresight audit` write the table states; this command prints its latest rows.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: calibration method.
        json: print only a JSON list: keys as the columns of table states, "T" and "T_prior" (4x4 row-major
            T_parent_child, null if unknown), and "in_words". Rows of sensors (`sensor` is not null) and rows of the
            edges, composed of the sensors' poses.
    """
    from jobs.terminal.known_vehicles import require_vehicle
    from jobs.terminal.state_text import state_text
    from jobs.terminal.summary import left_out, print_json
    from pipeline.store.current import current_states
    from pipeline.store.partitions import Lake
    from pipeline.store.records import read_records
    from pipeline.store.state_values import state_values
    from schemas.states import STATES, StateRow

    tables = Lake.existing(lake)
    found = [r for r in read_records(tables, STATES, StateRow, vehicle=vehicle) if r.method == method]
    if vehicle is not None and not found:
        require_vehicle(tables, vehicle)
    rows = state_values(current_states(found))
    if json:
        print_json(rows, indent=2)
    elif rows:
        sys.stdout.write(state_text(rows))
    else:
        sys.stdout.write(f"states: none in {lake}; boresight nightly and boresight audit write them\n")
    return 3 if left_out(tables) else 0
