"""Inputs of a network: sensor data independent of the guess, and the guess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import CLASS_CONFIDENCE
from schemas.training import GRID_CLASSES, UNKNOWN_CLASS

__all__ = ["NetworkInputs", "SensorInputs", "crop", "given_classes", "sensor_inputs"]


@dataclass(frozen=True, eq=False)
class SensorInputs:
    """One frame of each sensor, B frames; nothing here depends on the extrinsics.

    `camera` is red, green, blue (0..1) and 1 where the image shows the whole cell. Features are those named
    in LIDAR_FEATURES and RADAR_FEATURES, of the order of one on any rig: ranks, heights over the ground in
    units of 3 m, Doppler residuals in units of 5 m/s, power over the scan's median in units of 20 dB.
    `classes` is the result of a segmenter: the likelihood of each of GRID_CLASSES, and 1 where it is known;
    all 0 elsewhere.
    """

    camera: Float[Tensor, "B 4 H W"]
    classes: Float[Tensor, "B C H W"]
    lidar_xyz_m: Float[Tensor, "B N 3"]
    lidar_features: Float[Tensor, "B N 4"]
    lidar_valid: Bool[Tensor, "B N"]
    radar_xyz_m: Float[Tensor, "B M 3"]
    radar_features: Float[Tensor, "B M 3"]
    radar_valid: Bool[Tensor, "B M"]
    radar_has_elevation: Bool[Tensor, " B"]
    nearness: Float[Tensor, " B"]  # 1; in training a factor of the rendered nearness

    def map(self, function: Callable[[Tensor], Tensor]) -> SensorInputs:
        """Apply a function to every tensor (to a device, a slice of the frames)."""
        return replace(self, **{f.name: function(getattr(self, f.name)) for f in fields(self)})


@dataclass(frozen=True, eq=False)
class NetworkInputs:
    """Sensor data and the guess that they are to be looked at through; the three need not close the loop."""

    sensors: SensorInputs
    T_camera_lidar: Float[Tensor, "B 4 4"]
    T_camera_radar: Float[Tensor, "B 4 4"]
    T_lidar_radar: Float[Tensor, "B 4 4"]


def sensor_inputs(batch: TrainingBatch, grid: Grid) -> SensorInputs:
    """Inputs from a batch of table `training`, whose grid has the same cells and contains the network's."""
    camera = torch.cat([batch.image, batch.grid_seen[:, None] * 255], 1)
    return SensorInputs(
        crop(camera, batch.grid_step_deg, grid) / 255.0,
        given_classes(crop(batch.grid_class, batch.grid_step_deg, grid)),
        batch.lidar_xyz_m.float(),
        batch.lidar_features,
        batch.lidar_valid,
        batch.radar_xyz_m.float(),
        batch.radar_features,
        batch.radar_valid,
        batch.radar_has_elevation,
        torch.ones(len(batch), device=batch.image.device),
    )


def given_classes(grid_class: UInt8[Tensor, "B H W"]) -> Float[Tensor, "B C H W"]:
    """`SensorInputs.classes` of stored classes, one per cell (inference has shares: `sample.camera_maps`)."""
    count = len(GRID_CLASSES)
    known = (grid_class != UNKNOWN_CLASS)[:, None].float()
    hot = torch.stack([(grid_class == k).float() for k in range(count)], 1)
    likelihood = CLASS_CONFIDENCE * hot + (1 - CLASS_CONFIDENCE) / count
    return torch.cat([likelihood * known, known], 1)


def crop(
    stored: Float[Tensor, "B C Y X"] | Tensor, step_deg: float, grid: Grid
) -> Float[Tensor, "B C H W"] | Tensor:
    """Part of maps on the stored grid that the network's grid shows; ValueError if not contained."""
    rows, columns = grid.window((stored.shape[-2], stored.shape[-1]), step_deg)
    return stored[..., rows, columns]
