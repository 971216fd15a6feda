"""The radar's drivable area by a small network that learns from the lidar, on the radar's polar grid.

The label is the lidar's drivable ground, in the radar frame by the day's prior, the only calibration known
before calibrating; cells that the lidar did not see have no label. A wrong prior shifts labels; shifts to the
sides cancel over many vehicles and mirrored scans.

Source: paper, section 4.2 (weak supervision across sensors).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, UInt8
from torch import Tensor, nn
from torch.nn import functional

from pipeline.core.config import FleetConfig
from pipeline.core.rows import columns_of
from pipeline.learn.perception_training.trainer import (
    Labelled,
    Samples,
    Task,
    TrainingConfig,
    split_days,
    vehicle_days,
)
from pipeline.rig.day_prior import read_prior
from pipeline.rig.radar_grid import (
    CHANNELS,
    SHAPE,
    Scan,
    ScanMemory,
    cell_centres,
    grid_layout,
    sector_mask,
    sector_of,
)
from pipeline.rig.se3 import transform_points
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation

__all__ = [
    "BLOCKED", "FREE", "UNKNOWN", "DrivableSamples", "DrivableTraining", "RadarDrivable", "area_iou",
    "day_samples", "label_grid", "probabilities",
]  # fmt: skip

_DILATIONS = ((1, 1), (1, 2), (2, 4), (2, 8), (1, 1))  # directions, ranges
BLOCKED, FREE, UNKNOWN = 0, 1, 255
_SAMPLE = np.dtype(
    [("features", "f2", (len(CHANNELS), *SHAPE)), ("label", "u1", SHAPE), ("geometric", "?", SHAPE)]
)
_HALF_M = 64  # the lidar's grid of 1 m cells covers the radar's reach around it


class DrivableTraining(TrainingConfig):
    """Defaults that suit some hundred scans."""

    steps: int = 600
    batch_size: int = 8
    learning_rate: float = 3e-3
    width: int = 24
    frames_per_day: int = 100


@dataclass(frozen=True, eq=False)
class DrivableSamples(Labelled):
    """Samples of one or many days; `geometric` is the fallback's answer, for comparison only."""

    features: Float16[np.ndarray, "N C A R"]
    label: UInt8[np.ndarray, "N A R"]
    geometric: Bool[np.ndarray, "N A R"]


class DrivableNetwork(nn.Module):
    """Features to the logit that a cell is drivable: 27 k parameters at width 24."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.first = nn.Conv2d(len(CHANNELS), width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in _DILATIONS)
        self.last = nn.Conv2d(width, 1, 1)

    def forward(self, features: Float[Tensor, "B C A R"]) -> Float[Tensor, "B A R"]:
        """Logits."""
        x = torch.relu(self.first(features))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        logits: Tensor = self.last(x)[:, 0]
        return logits


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


def _scan_of(observation: Observation) -> Scan:
    """The scan as perception had it when it wrote the row."""
    velocity, speed = observation.radar_velocity_mps, observation.ego_speed_mps
    own = None if speed is None else (float(speed), 0.0)
    return Scan(
        observation.radar_stamp_ns, observation.drive, observation.radar_xyz_m, observation.radar_power_db,
        observation.radar_residual_mps, observation.radar_motion, observation.radar_has_elevation,
        own if velocity is None else (float(velocity[0]), float(velocity[1])), observation.ego_yaw_rate_radps,
    )  # fmt: skip


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
        features = memory.features(_scan_of(observation))
        if i in kept:
            sector = observation.radar_drivable_azimuth_rad, observation.radar_drivable_range_m
            yield features.astype(np.float16), label_grid(observation, T_lidar_radar), sector_mask(*sector)


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


class RadarDrivable(Task[DrivableSamples]):
    """Scores compare with the best constant answer: the most frequent label of each cell."""

    name = "radar_drivable"
    purpose = "drivable area of a radar's scan (paper, section 4.2): radar.drivable of a rig"
    limits = (
        "Learned from the lidar's drivable ground through each day's prior, with the errors of both.",
        "Valid for the radars, roads and weather of its samples only.",
        "Cells without lidar returns were not used in training: large free ranges are extrapolated.",
    )
    config = DrivableTraining
    unlabelled = UNKNOWN
    network = DrivableNetwork

    def __init__(self, train: DrivableSamples) -> None:
        super().__init__(train)
        free, known = (train.label == FREE).sum(axis=0), (train.label != UNKNOWN).sum(axis=0)
        self.guess = 2 * free > known

    @staticmethod
    def samples(fleet: FleetConfig, lake: Lake, config: DrivableTraining) -> Samples[DrivableSamples]:
        """Samples of all vehicle-days with observations, labelled through their priors."""

        def of_day(day: Partition) -> DrivableSamples:
            rows = list(observations_of(lake, day, chosen=fleet.rig_of(day.vehicle).one_of_each("training")))
            prior = read_prior(rows, fleet, day.vehicle)
            return day_samples(rows, prior.T_lidar_radar, config.frames_per_day)

        return split_days(vehicle_days(fleet, lake), of_day)

    def loss(self, network: nn.Module, batch: DrivableSamples, rng: np.random.Generator) -> Float[Tensor, ""]:
        """Binary cross-entropy per labelled cell, by the root of the cell's area; half of the scans are mirrored."""
        # A mirrored world is equally valid, and cancels the shift of a wrong prior to one side.
        mirror = rng.random(len(batch)) < 0.5
        features = np.where(mirror[:, None, None, None], batch.features[:, :, ::-1], batch.features)
        label = np.where(mirror[:, None, None], batch.label[:, ::-1], batch.label)
        logits = network(torch.from_numpy(features).float())
        weight = torch.from_numpy((label != UNKNOWN) * np.sqrt(cell_centres()[1])).float()
        target = torch.from_numpy(label == FREE).float()
        losses = functional.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum")
        return losses / weight.sum().clamp(min=1)

    def scores(self, network: nn.Module, held_out: DrivableSamples) -> dict[str, float]:
        """IoU with the lidar's labels, of the network, the geometric fallback and the constant answer."""
        sectors = np.stack([sector_mask(*sector_of(p)) for p in probabilities(network, held_out)])
        return {
            "iou_network": area_iou(sectors, held_out.label),
            "iou_geometric": area_iou(held_out.geometric, held_out.label),
            "iou_constant": area_iou(np.broadcast_to(self.guess, held_out.label.shape), held_out.label),
        }

    def graph(self, network: nn.Module) -> tuple[nn.Module, Tensor, tuple[str, str], str]:
        """Features to probabilities."""
        layout = "".join(f"{key} = {json.dumps(value)}\n" for key, value in grid_layout().items())
        manifest = f'task = "radar_drivable"\n\n[grid]\n{layout}'
        example = torch.zeros(1, len(CHANNELS), *SHAPE)
        return nn.Sequential(network, nn.Sigmoid()), example, ("features", "drivable"), manifest


def area_iou(answer: np.ndarray, label: np.ndarray) -> float:
    """IoU of areas [m2] over all samples; cells without label do not count."""
    area = np.broadcast_to(cell_centres()[1], label.shape) * (label != UNKNOWN)
    free = label == FREE
    return float((area * (answer & free)).sum() / max((area * (answer | free)).sum(), 1e-9))


def probabilities(network: nn.Module, samples: DrivableSamples) -> Float[np.ndarray, "N A R"]:
    """How likely each cell is drivable."""
    batches = (samples.features[i : i + 16] for i in range(0, len(samples), 16))
    with torch.no_grad():
        return torch.cat([torch.sigmoid(network(torch.from_numpy(b).float())) for b in batches]).numpy()
