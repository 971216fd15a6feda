"""What an earlier day of the same vehicle found: a place for today's search to look at, and nothing more."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.errors import ContractError
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord

__all__ = ["accepted_before"]

# Days with records that are looked at: a vehicle that was held for longer has no state worth a look.
_DAYS_BACK = 10


def accepted_before(lake: Lake, partition: Partition, method: str) -> Float[np.ndarray, "4 4"] | None:
    """T_camera_lidar of the vehicle's latest earlier day on which it was accepted; None where there is none.

    No information about today's pose, so no part of the work key: the search looks there only where its other origins
    do not agree, and what it finds there is judged like anything else.
    """
    known = lake.partitions(CALIBRATIONS.name, partition.vehicle)
    days = sorted({p.day for p in known if p.day < partition.day}, reverse=True)
    for day in days[:_DAYS_BACK]:
        try:
            records = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle, day=day)
        except ContractError:  # a damaged record of another day is that day's matter
            continue
        for record in current_records(records):
            if (record.pair, record.method, record.status) == ("camera_lidar", method, "accepted"):
                return transform_of(record)
    return None
