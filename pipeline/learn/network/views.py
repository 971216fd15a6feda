"""Sensor data rendered at a guess: input of the networks, rendered again at every refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pipeline.learn.network.inputs import NetworkInputs
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.rendering import render_lidar, render_radar
from pipeline.objective.differentiable.poses import transform_points

__all__ = ["RenderedView", "render"]


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
        scans.append(render_radar(radar[b, seen], radar_features[b, seen], grid))
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
