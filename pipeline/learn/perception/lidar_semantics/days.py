"""The samples of a lake: vehicle-days with the calibration that carries the camera's classes to the sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.config import FleetConfig
from pipeline.errors import ContractError
from pipeline.extrinsics.prior import read_prior
from pipeline.learn.perception.lidar_semantics.samples import (
    SweepImages,
    SweepLayout,
    cut,
    day_images,
    layout_of,
)
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_records
from pipeline.store.views import frames_of, observations_of, perceived_days
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.observations import Observation

__all__ = ["SweepSamples", "labelled_sweeps"]

_HELD_OUT_EVERY = 5  # vehicle-days


@dataclass(frozen=True, eq=False)
class SweepSamples:
    """What a lake teaches: sweeps to learn from, held-out sweeps, their layout, and their numbers for the card."""

    train: SweepImages
    held_out: SweepImages
    layout: SweepLayout
    numbers: dict[str, int]


@dataclass(frozen=True, eq=False)
class _Day:
    partition: Partition
    observations: list[Observation]
    T_camera_lidar: Float[np.ndarray, "4 4"]
    calibrated: bool  # whether that is an accepted calibration, not the prior


def labelled_sweeps(
    fleet: FleetConfig, lake: Lake, size: tuple[int, int], frames_per_day: int
) -> SweepSamples:
    """Sweeps of all vehicle-days with observations; every fifth day is held out.

    Args:
        fleet: says where each vehicle's prior comes from.
        lake: with frames and observations, and perhaps calibrations.
        size: rows and columns of the range image.
        frames_per_day: at most, evenly spread.

    Raises:
        ContractError: fewer than two vehicle-days of vehicles in fleet.toml.
    """
    days = _days(fleet, lake)
    layout = layout_of((next(frames_of(lake, day.partition)) for day in days), *size)
    parts = [
        day_images(frames_of(lake, d.partition), d.observations, d.T_camera_lidar, layout, frames_per_day)
        for d in days
    ]
    train, held_out = cut(
        [image for k, part in enumerate(parts) if not _is_held_out(k) for image in part],
        [image for k, part in enumerate(parts) if _is_held_out(k) for image in part],
    )
    numbers = {
        "vehicle_days": len(days),
        "calibrated_days": sum(day.calibrated for day in days),
        "samples": len(train),
        "held_out_samples": len(held_out),
    }
    return SweepSamples(train, held_out, layout, numbers)


def _is_held_out(day: int) -> bool:
    return day % _HELD_OUT_EVERY == 1  # the second day already: two days are enough


def _days(fleet: FleetConfig, lake: Lake) -> Sequence[_Day]:
    """Each day by its accepted camera-lidar calibration where the lake has one, else by its prior."""
    partitions = [p for p in perceived_days(lake) if fleet.knows(p.vehicle)]
    if len(partitions) < 2:
        problem = (
            f"{len(partitions)} vehicle-days with observations of vehicles in fleet.toml: two are needed"
        )
        raise ContractError(str(lake.root), problem)
    accepted = {
        (r.vehicle, r.day): transform_of(r)
        for r in current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
        if r.pair == "camera_lidar" and r.status == "accepted"
    }
    days = []
    for partition in partitions:
        rows = list(observations_of(lake, partition))
        known = accepted.get((partition.vehicle, partition.day))
        if known is None:
            prior = read_prior(rows, fleet, partition.vehicle)
            days.append(_Day(partition, rows, prior.T_camera_lidar, False))
        else:
            days.append(_Day(partition, rows, known, True))
    return days
