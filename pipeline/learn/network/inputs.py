"""Inputs of a network: sensor data independent of the guess, and the guess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import CLASS_CONFIDENCE, FEATURE_UNITS
from schemas.training import GRID_CLASSES, POINT_IS_EDGE, POINT_IS_GROUND, UNKNOWN_CLASS

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
    flags = batch.lidar_flags
    lidar_features = torch.stack(
        [
            batch.lidar_intensity / 255.0,
            heights(batch.lidar_xyz_m, batch.lidar_valid, batch.ground_plane) / FEATURE_UNITS["height"],
            ((flags & POINT_IS_EDGE) > 0).float(),
            ((flags & POINT_IS_GROUND) > 0).float(),
        ],
        -1,
    )
    return SensorInputs(
        crop(camera, batch.grid_step_deg, grid) / 255.0,
        given_classes(crop(batch.grid_class, batch.grid_step_deg, grid)),
        batch.lidar_xyz_m.float(),
        lidar_features.float(),
        batch.lidar_valid,
        batch.radar_xyz_m.float(),
        radar_features(batch.radar_residual_mps, batch.radar_power_db, batch.radar_motion == 1),
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


def radar_features(
    residual_mps: Float[Tensor, "B M"], power_db: Float[Tensor, "B M"], moving: Bool[Tensor, "B M"]
) -> Float32[Tensor, "B M 3"]:
    """RADAR_FEATURES from Doppler residuals, power over the scan's median, and perception's motion."""
    speed = (residual_mps.abs() / FEATURE_UNITS["speed"]).clamp(max=2.0)
    power = (power_db / FEATURE_UNITS["power"]).clamp(-2.0, 2.0)
    return torch.stack([speed, power, moving.to(speed.dtype)], -1).float()


def heights(
    xyz_m: Float[Tensor, "B N 3"], valid: Bool[Tensor, "B N"], plane: Float[Tensor, "B 4"]
) -> Float32[Tensor, "B N"]:
    """Height over the ground plane [m], or over the frame's lowest points without a plane (zeros)."""
    known = plane[:, :3].norm(dim=-1, keepdim=True) > 0.5
    above_plane = (xyz_m * plane[:, None, :3].to(xyz_m.dtype)).sum(-1) + plane[:, 3:].to(xyz_m.dtype)
    z = xyz_m[..., 2]
    lowest = torch.where(valid, z, torch.full_like(z, 1e3)).sort(dim=1).values
    # The 2 % quantile of the real points stands for the ground: reflections from below it are rare.
    at = (valid.sum(1, keepdim=True).float() * 0.02).long()
    return torch.where(known, above_plane, z - lowest.gather(1, at)).clamp(-5.0, 30.0).float()


def crop(
    stored: Float[Tensor, "B C Y X"] | Tensor, step_deg: float, grid: Grid
) -> Float[Tensor, "B C H W"] | Tensor:
    """Part of maps on the stored grid that the network's grid shows; ValueError if not contained."""
    rows, columns = grid.window((stored.shape[-2], stored.shape[-1]), step_deg)
    return stored[..., rows, columns]
