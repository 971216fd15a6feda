"""The samples of a lake: vehicle-days with the calibration that carries the camera's classes to the sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.config import FleetConfig
from pipeline.extrinsics.prior import read_prior
from pipeline.learn.perception.days import is_held_out, vehicle_days
from pipeline.learn.perception.lidar_semantics.samples import (
    SweepImages,
    SweepLayout,
    cut,
    day_images,
    layout_of,
)
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from pipeline.store.views import frames_of, observations_of
from schemas.calibrations import CALIBRATIONS, CalibrationRecord

__all__ = ["SweepSamples", "labelled_sweeps"]


@dataclass(frozen=True, eq=False)
class SweepSamples:
    """What a lake teaches: sweeps to learn from, held-out sweeps, their layout, and their numbers for the card."""

    train: SweepImages
    held_out: SweepImages
    layout: SweepLayout
    numbers: dict[str, int]


def labelled_sweeps(
    fleet: FleetConfig, lake: Lake, size: tuple[int, int], frames_per_day: int
) -> SweepSamples:
    """Sweeps of all vehicle-days with observations; every fifth day is held out.

    Each day by its accepted camera-lidar calibration where the lake has one, else by its prior.

    Args:
        fleet: says where each vehicle's prior comes from.
        lake: with frames and observations, and perhaps calibrations.
        size: rows and columns of the range image.
        frames_per_day: at most, evenly spread.

    Raises:
        ContractError: fewer than two vehicle-days of vehicles in fleet.toml.
    """
    days = vehicle_days(fleet, lake, least=2)
    chosen = {day.vehicle: fleet.rig_of(day.vehicle).one_of_each("training") for day in days}
    accepted = {
        (r.vehicle, r.day): transform_of(r)
        for r in current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
        if r.status == "accepted" and _is_of(r, chosen)
    }
    layout = layout_of((next(frames_of(lake, day, chosen=chosen[day.vehicle])) for day in days), *size)
    sides: tuple[list[tuple[np.ndarray, np.ndarray]], ...] = ([], [])
    for number, day in enumerate(days):
        names = chosen[day.vehicle]
        rows = list(observations_of(lake, day, chosen=names))
        known = accepted.get((day.vehicle, day.day))
        T = read_prior(rows, fleet, day.vehicle).T_camera_lidar if known is None else known
        sides[is_held_out(number)].extend(
            day_images(frames_of(lake, day, chosen=names), rows, T, layout, frames_per_day)
        )
    train, held_out = cut(*sides)
    numbers = {
        "vehicle_days": len(days),
        "calibrated_days": sum((day.vehicle, day.day) in accepted for day in days),
        "samples": len(train),
        "held_out_samples": len(held_out),
    }
    return SweepSamples(train, held_out, layout, numbers)


def _is_of(record: CalibrationRecord, chosen: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether a record is of its vehicle's chosen camera and lidar."""
    names = chosen.get(record.vehicle, {})
    return (record.parent_frame, record.child_frame) == (names.get("camera"), names.get("lidar"))
