"""States as commands show them: columns, transform, and prior of the last day."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.store.partitions import Lake
    from schemas.states import StateRow

__all__ = ["state_rows"]


def state_rows(lake: Lake, states: Sequence[StateRow]) -> list[dict[str, Any]]:
    """Each state as a dict of its columns, "T", and "T_prior" of its last day (4x4 or None)."""
    from pipeline.geometry.se3 import inverse
    from pipeline.store.current import current_records, prior_of, transform_of
    from pipeline.store.records import read_records
    from schemas.calibrations import CALIBRATIONS, CalibrationRecord
    from schemas.states import STATES

    priors = {}
    prior_columns = [c.name for c in CALIBRATIONS.columns if c.name.startswith("prior_")]
    for day in sorted({s.days[-1] for s in states if s.days}):
        among = {s.vehicle for s in states if s.days and s.days[-1] == day}
        rows = read_records(
            lake, CALIBRATIONS, CalibrationRecord, day=day, vehicle=among, columns=prior_columns
        )
        for record in current_records(rows):
            T, ends = prior_of(record), (record.parent_frame, record.child_frame)
            of = record.vehicle, record.method
            priors[*of, *ends, day] = T
            priors[*of, *ends[::-1], day] = None if T is None else inverse(T)  # for poses
    return [
        {c.name: getattr(s, c.name) for c in STATES.columns}
        | {
            "T": transform_of(s),
            "T_prior": priors.get(
                (s.vehicle, s.method, s.parent_frame, s.child_frame, s.days[-1] if s.days else "")
            ),
        }
        for s in states
    ]
