"""Sensor data rendered at a guess: input of the networks, rendered again at every refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pipeline.learn.network.inputs import NetworkInputs
from pipeline.learn.network.markings import mark_strength
from pipeline.learn.network.rendering import nearest_points, paint
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import (
    EDGE_BONUS,
    GROUND_WEIGHT,
    LIDAR_FEATURES,
    MARGIN_DEG,
    MARKED_POINTS,
    MATCHED_POINTS,
    NEAR_M,
    NEARNESS_M,
    OBJECT_BONUS,
    OBJECT_POINTS,
)
from pipeline.objective.differentiable.poses import transform_points

__all__ = ["RenderedView", "render"]

_MARGIN = float(np.radians(MARGIN_DEG))
_EDGE, _GROUND = LIDAR_FEATURES.index("edge"), LIDAR_FEATURES.index("ground")


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
    """View at the inputs' guess, with a segmenter's classes if given; lidar point of each cell, or -1."""
    sensors = inputs.sensors
    lidar_camera = transform_points(inputs.T_camera_lidar, sensors.lidar_xyz_m)
    radar_camera = transform_points(inputs.T_camera_radar, sensors.radar_xyz_m)
    index = nearest_points(lidar_camera, sensors.lidar_valid, grid)
    radar_index = nearest_points(radar_camera, sensors.radar_valid, grid)
    edge, ground = sensors.lidar_features[..., _EDGE], sensors.lidar_features[..., _GROUND]
    in_view = sensors.lidar_valid & _in_view(lidar_camera, grid)
    rank = _importance(lidar_camera.shape[1], edge.device)
    matched = _best(rank + EDGE_BONUS * edge + OBJECT_BONUS * (1 - ground), in_view, MATCHED_POINTS)
    solid = _best(rank.expand_as(ground), in_view & (ground < 0.5), OBJECT_POINTS)
    weight = torch.where(ground > 0.5, GROUND_WEIGHT, 1.0) * in_view
    painted = paint(
        index, _channels(lidar_camera, sensors.lidar_features, sensors.nearness[:, None, None]), grid
    )
    strength, cell = torch.topk(mark_strength(painted).flatten(1), MARKED_POINTS, dim=1)
    view = RenderedView(
        torch.cat([sensors.camera, sensors.classes], 1) if classes else sensors.camera,
        painted,
        paint(radar_index, _channels(radar_camera, sensors.radar_features), grid),
        _pick(lidar_camera, matched),
        weight.gather(1, matched),
        _pick(sensors.lidar_xyz_m, solid),
        (in_view & (ground < 0.5)).to(weight.dtype).gather(1, solid),
        transform_points(inputs.T_lidar_radar, sensors.radar_xyz_m),
        radar_camera,
        sensors.radar_features,
        sensors.radar_valid,
        sensors.radar_has_elevation,
        _pick(lidar_camera, index.gather(1, cell).clamp(min=0)) * (strength > 0)[..., None],
        strength,
    )
    return view, index


def _importance(count: int, device: torch.device | str = "cpu") -> Float[Tensor, " N"]:
    """A fixed irregular number in 0..1 per row: picks points evenly, and the same ones on every machine."""
    number = torch.arange(count, device=device, dtype=torch.int64)
    return ((number * 2654435761) % 65536).float() / 65536  # Knuth's multiplicative hash


def _channels(points_camera: Tensor, features: Tensor, factor: Tensor | float = 1.0) -> Tensor:
    distance = points_camera.norm(dim=-1, keepdim=True).clamp(min=NEAR_M)
    nearness = (factor * NEARNESS_M / distance).clamp(max=2.0)
    return torch.cat([torch.ones_like(distance), nearness, features], -1)


def _in_view(points_camera: Tensor, grid: Grid) -> Tensor:
    """True inside the grid and a margin; a plain angular box, by tangents."""
    x, y, z = points_camera.unbind(-1)
    flat = torch.sqrt(x * x + z * z)
    side = float(np.tan(np.radians(grid.left_deg) + _MARGIN))
    up, down = (
        float(np.tan(np.radians(e) + m)) for e, m in ((grid.top_deg, _MARGIN), (grid.bottom_deg, -_MARGIN))
    )
    return (z > NEAR_M) & (x.abs() < side * z) & (-y < up * flat) & (-y > down * flat)


def _best(score: Tensor, allowed: Tensor, count: int) -> Tensor:
    """Rows of the `count` highest scores, allowed ones first; fewer if there are fewer."""
    ranked = torch.where(allowed, score, score - 10.0)
    return torch.topk(ranked, min(count, ranked.shape[1]), dim=1).indices


def _pick(values: Tensor, rows: Tensor) -> Tensor:
    return values.gather(1, rows[..., None].expand(-1, -1, values.shape[-1]))
