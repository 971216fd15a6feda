"""Training samples of the radar's drivable area: radar grids, labelled by the lidar.

The label is the lidar's drivable ground, in the radar frame by the day's prior, the only calibration known
before calibrating; cells that the lidar did not see have no label. A wrong prior shifts labels; shifts to the
sides cancel over many vehicles and mirrored scans.

Source: paper, section 4.2 (weak supervision across sensors).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float16, UInt8

from pipeline.core.config import FleetConfig
from pipeline.core.rows import columns_of, join_rows, take_rows
from pipeline.learn.perception_training.days import is_held_out, vehicle_days
from pipeline.rig.day_prior import read_prior
from pipeline.rig.radar_grid import CHANNELS, SHAPE, Scan, ScanMemory, cell_centres, sector_mask
from pipeline.rig.se3 import transform_points
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation

__all__ = [
    "BLOCKED",
    "FREE",
    "UNKNOWN",
    "DrivableSamples",
    "day_samples",
    "drivable_samples",
    "label_grid",
    "samples_of_day",
    "scan_of",
]

BLOCKED, FREE, UNKNOWN = 0, 1, 255
_SAMPLE = np.dtype(
    [("features", "f2", (len(CHANNELS), *SHAPE)), ("label", "u1", SHAPE), ("geometric", "?", SHAPE)]
)
_HALF_M = 64  # the lidar's grid of 1 m cells covers the radar's reach around it


@dataclass(frozen=True, eq=False)
class DrivableSamples:
    """Samples of one or many days; `geometric` is the fallback's answer, for comparison only."""

    features: Float16[np.ndarray, "N C A R"]
    label: UInt8[np.ndarray, "N A R"]
    geometric: Bool[np.ndarray, "N A R"]

    def __len__(self) -> int:
        return len(self.label)


def drivable_samples(
    fleet: FleetConfig, lake: Lake, frames_per_day: int
) -> tuple[DrivableSamples, DrivableSamples, dict[str, int]]:
    """Training samples, held-out samples (every fifth vehicle-day), and their numbers for the card.

    Of a single day, the first 0.7 are for training and the last 0.2 are held out.

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


def day_samples(
    observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"], limit: int
) -> DrivableSamples:
    """Samples of a vehicle-day, at most `limit`, evenly spread, of frames with drivable ground.

    `observations` are in the order of their stamps, because earlier scans appear in later samples.
    `T_lidar_radar` is the day's prior, never a truth.
    """
    usable = [i for i, o in enumerate(observations) if len(o.lidar_drivable_xyz_m)]
    kept = {usable[k] for k in np.linspace(0, len(usable) - 1, min(limit, len(usable))).astype(int)}
    return DrivableSamples(**columns_of(list(_rows(observations, T_lidar_radar, kept)), _SAMPLE))


def scan_of(observation: Observation) -> Scan:
    """The scan as perception had it when it wrote the row."""
    velocity = observation.radar_velocity_mps
    speed = observation.ego_speed_mps
    own = None if speed is None else (float(speed), 0.0)
    return Scan(
        observation.radar_stamp_ns,
        observation.drive,
        observation.radar_xyz_m,
        observation.radar_power_db,
        observation.radar_residual_mps,
        observation.radar_motion,
        observation.radar_has_elevation,
        own if velocity is None else (float(velocity[0]), float(velocity[1])),
        observation.ego_yaw_rate_radps,
    )


def label_grid(observation: Observation, T_lidar_radar: Float[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "A R"]:
    """FREE, BLOCKED or UNKNOWN by the lidar, at each cell of the radar's grid.

    A cell's centre is looked up at the radar's height, which a tilt of 2 deg moves by centimetres.
    """
    free, seen = _occupied(observation.lidar_drivable_xyz_m), _occupied(observation.lidar_map_xyz_m)
    azimuth, ranges = cell_centres()
    x, y = ranges * np.cos(azimuth)[:, None], ranges * np.sin(azimuth)[:, None]
    lidar = transform_points(T_lidar_radar, np.stack([x, y, np.zeros(SHAPE)], axis=-1).reshape(-1, 3))
    column, row, inside = _cell(lidar)
    is_free = inside & free[column, row]
    known = is_free | (inside & seen[column, row])
    return np.where(is_free, FREE, np.where(known, BLOCKED, UNKNOWN)).astype(np.uint8).reshape(SHAPE)


def _rows(
    observations: Sequence[Observation], T_lidar_radar: np.ndarray, kept: set[int]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    memory = ScanMemory()
    for i, observation in enumerate(observations):
        features = memory.features(scan_of(observation))
        if i in kept:
            geometric = sector_mask(
                observation.radar_drivable_azimuth_rad, observation.radar_drivable_range_m
            )
            yield features.astype(np.float16), label_grid(observation, T_lidar_radar), geometric


def _occupied(xyz_m: np.ndarray) -> np.ndarray:
    out = np.zeros((2 * _HALF_M, 2 * _HALF_M), bool)
    column, row, inside = _cell(xyz_m)
    out[column[inside], row[inside]] = True
    return out


def _cell(xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell of 1 m around the lidar of each point, and whether it is one."""
    cell = np.floor(xyz_m[:, :2]).astype(int) + _HALF_M
    inside = np.all((cell >= 0) & (cell < 2 * _HALF_M), axis=1)
    return np.where(inside, cell[:, 0], 0), np.where(inside, cell[:, 1], 0), inside
