"""Result of an earlier day of the same vehicle, as one more start of today's search."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.graph import Edge
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake, Partition, days_after
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.columns import POSE_COLUMNS

__all__ = ["accepted_before"]

# Days with records that are looked at: a vehicle that was held for longer has no state worth a look.
_DAYS_BACK = 10
# A vehicle that drives once a week has ten days in a quarter; older days are not read.
_CALENDAR_DAYS_BACK = 92


def accepted_before(
    lake: Lake, partition: Partition, method: str, edge: Edge
) -> Float[np.ndarray, "4 4"] | None:
    """T_parent_child of an edge on its latest earlier accepted day; None if there is none.

    It carries no information about today's pose and is no part of the work key: the search starts there only
    if the day alone does not decide, and the result is judged like any other.
    """
    found = read_records(
        lake,
        CALIBRATIONS,
        CalibrationRecord,
        vehicle=partition.vehicle,
        first=days_after(partition.day, -_CALENDAR_DAYS_BACK),
        last=days_after(partition.day, -1),
        columns=POSE_COLUMNS,
    )
    wanted = (edge.parent.name, edge.child.name, method, "accepted")
    records = current_records(found)
    days = sorted({r.day for r in records}, reverse=True)[:_DAYS_BACK]
    for record in reversed(records):
        if (
            record.day in days
            and (record.parent_frame, record.child_frame, record.method, record.status) == wanted
        ):
            return transform_of(record)
    return None
