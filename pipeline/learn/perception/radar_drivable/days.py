"""The samples of a lake: vehicle-days, labelled by the lidar through each day's prior."""

from __future__ import annotations

import numpy as np

from pipeline.config import FleetConfig
from pipeline.extrinsics.prior import read_prior
from pipeline.learn.perception.days import is_held_out, vehicle_days
from pipeline.learn.perception.radar_drivable.samples import DrivableSamples, day_samples
from pipeline.rows import join_rows, take_rows
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of

__all__ = ["drivable_samples", "samples_of_day"]


def drivable_samples(
    fleet: FleetConfig, lake: Lake, frames_per_day: int
) -> tuple[DrivableSamples, DrivableSamples, dict[str, int]]:
    """Samples to learn from, held-out samples (every fifth vehicle-day), and their numbers for the card.

    A single day is cut in time: its first 0.7 teach, its last 0.2 are held out.

    Raises:
        ContractError: no observations of a vehicle in fleet.toml.
    """
    days = vehicle_days(fleet, lake, least=1)
    parts = [samples_of_day(fleet, lake, day, frames_per_day) for day in days]
    if len(parts) == 1:
        # Neighbouring scans are alike: a tenth between the two sides belongs to neither.
        rows, total = np.arange(len(parts[0])), len(parts[0])
        train, held_out = (
            take_rows(parts[0], r) for r in (rows[: int(0.7 * total)], rows[int(0.8 * total) :])
        )
    else:
        train, held_out = (
            join_rows([p for i, p in enumerate(parts) if is_held_out(i) == side]) for side in (False, True)
        )
    numbers = {"vehicle_days": len(days), "samples": len(train), "held_out_samples": len(held_out)}
    return train, held_out, numbers


def samples_of_day(fleet: FleetConfig, lake: Lake, day: Partition, frames_per_day: int) -> DrivableSamples:
    """At most `frames_per_day` samples of a vehicle-day, evenly spread, labelled through its prior."""
    rows = list(observations_of(lake, day, chosen=fleet.rig_of(day.vehicle).one_of_each("training")))
    return day_samples(rows, read_prior(rows, fleet, day.vehicle).T_lidar_radar, frames_per_day)
