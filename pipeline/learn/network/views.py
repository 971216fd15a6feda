"""Sensor data, a guess, and the view of the one through the other: input of the networks, rendered at every pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.sample.grid import CLASS_CONFIDENCE, Grid
from pipeline.learn.sample.rendering import painted, render_lidar
from pipeline.objective.differentiable.projection import transform_points
from schemas.training import GRID_CLASSES, UNKNOWN_CLASS

__all__ = [
    "NetworkInputs", "RenderedView", "SensorInputs", "crop", "given_classes", "grid_cells", "render",
    "sensor_inputs", "sphere",
]  # fmt: skip


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


@dataclass(frozen=True, eq=False)
class NetworkInputs:
    """Sensor data and the guess that they are to be looked at through; the three need not close the loop."""

    sensors: SensorInputs
    T_camera_lidar: Float[Tensor, "B 4 4"]
    T_camera_radar: Float[Tensor, "B 4 4"]
    T_lidar_radar: Float[Tensor, "B 4 4"]


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One frame of each sensor through one guess, B frames; fields are inputs of the exported graph."""

    camera: Float[Tensor, "B C H W"]  # `NetworkConfig.camera_channels`
    lidar_grid: Float[Tensor, "B 6 H W"]
    radar_grid: Float[Tensor, "B 5 H W"]
    points_camera: Float[Tensor, "B N 3"]  # lidar points to be matched, optical frame [m]
    point_weight: Float[Tensor, "B N"]  # 0 = absent
    objects: Float[Tensor, "B L 3"]  # lidar points off the ground, lidar frame [m]
    object_weight: Float[Tensor, "B L"]
    radar_lidar: Float[Tensor, "B M 3"]  # detections, lidar frame [m]
    radar_camera: Float[Tensor, "B M 3"]  # detections, optical frame through T_camera_radar [m]
    radar_features: Float[Tensor, "B M 3"]
    radar_valid: Bool[Tensor, "B M"]
    radar_has_elevation: Bool[Tensor, " B"]
    marks_camera: Float[Tensor, "B P 3"]  # lidar points on bright ground, optical frame [m]
    mark_weight: Float[Tensor, "B P"]  # 0 = absent


def sensor_inputs(batch: TrainingBatch, grid: Grid) -> SensorInputs:
    """Inputs from a batch of table `training`, whose grid has the same cells and contains the network's."""
    camera = torch.cat([batch.image, batch.grid_seen[:, None] * 255], 1)
    return SensorInputs(
        crop(camera, batch.grid_step_deg, grid) / 255.0,
        given_classes(crop(batch.grid_class, batch.grid_step_deg, grid)), batch.lidar_xyz_m.float(),
        batch.lidar_features, batch.lidar_valid, batch.radar_xyz_m.float(), batch.radar_features,
        batch.radar_valid, batch.radar_has_elevation, torch.ones(len(batch), device=batch.image.device),
    )  # fmt: skip


def given_classes(grid_class: UInt8[Tensor, "B H W"]) -> Float[Tensor, "B C H W"]:
    """`SensorInputs.classes` of stored classes, one per cell (inference has shares: `sample.frame_sample`)."""
    count = len(GRID_CLASSES)
    known = (grid_class != UNKNOWN_CLASS)[:, None].float()
    hot = torch.stack([(grid_class == k).float() for k in range(count)], 1)
    likelihood = CLASS_CONFIDENCE * hot + (1 - CLASS_CONFIDENCE) / count
    return torch.cat([likelihood * known, known], 1)


def crop(stored: Tensor, step_deg: float, grid: Grid) -> Tensor:
    """Part of maps on the stored grid that the network's grid shows; ValueError if not contained."""
    return stored[..., *grid.window((stored.shape[-2], stored.shape[-1]), step_deg)]


def render(
    inputs: NetworkInputs, grid: Grid, *, classes: bool = False
) -> tuple[RenderedView, Int64[Tensor, "B HW"]]:
    """View at the inputs' guess, with a segmenter's classes if given; lidar point of each cell, or -1.

    Points are rendered frame by frame on the CPU, as in inference; no gradient flows from a view to a guess.
    """
    sensors, device = inputs.sensors, inputs.T_camera_lidar.device
    radar_camera = transform_points(inputs.T_camera_radar, sensors.radar_xyz_m)
    lidar, points, features, valid, nearness, radar, radar_features, radar_valid = (
        t.detach().cpu().numpy()
        for t in (
            inputs.T_camera_lidar.double(), sensors.lidar_xyz_m, sensors.lidar_features, sensors.lidar_valid,
            sensors.nearness, radar_camera, sensors.radar_features, sensors.radar_valid,
        )
    )  # fmt: skip
    views, indices, scans = [], [], []
    for b, T_camera_lidar in enumerate(lidar):
        rows, seen = np.flatnonzero(valid[b]), radar_valid[b]
        found, index = render_lidar(
            points[b, rows], features[b, rows], T_camera_lidar, grid, nearness=float(nearness[b])
        )
        views.append(found)
        indices.append(np.where(index >= 0, np.append(rows, -1)[index], -1))
        scans.append(painted(radar[b, seen], radar_features[b, seen], grid)[0])
    view = RenderedView(
        torch.cat([sensors.camera, sensors.classes], 1) if classes else sensors.camera,
        radar_grid=torch.from_numpy(np.stack(scans)).to(device),
        radar_lidar=transform_points(inputs.T_lidar_radar, sensors.radar_xyz_m),
        radar_camera=radar_camera,
        radar_features=sensors.radar_features,
        radar_valid=sensors.radar_valid,
        radar_has_elevation=sensors.radar_has_elevation,
        **{name: torch.from_numpy(np.stack([v[name] for v in views])).to(device) for name in views[0]},
    )
    return view, torch.from_numpy(np.stack(indices)).to(device)


def sphere(points_camera: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    """Azimuth (left), elevation (up) [rad] and range [m] of points in the optical frame.

    Computed by arctangents of quotients, which every ONNX runtime has; points behind the camera get +-90 deg.
    """
    x, y, z = points_camera.unbind(-1)
    ahead = torch.clamp(z, min=1e-3)
    flat = torch.sqrt(x * x + ahead * ahead)
    return torch.stack([torch.atan(-x / ahead), torch.atan(-y / flat), torch.sqrt(flat * flat + y * y)], -1)


def grid_cells(
    angles: Float[Tensor, "B N 3"], grid: Grid
) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
    """Row and column of directions as fractions of cells: cell (i, j) spans i..i+1, j..j+1."""
    cell = np.radians(grid.cell_deg)
    row = (np.radians(grid.top_deg) - angles[..., 1]) / cell
    return row, (np.radians(grid.left_deg) - angles[..., 0]) / cell
