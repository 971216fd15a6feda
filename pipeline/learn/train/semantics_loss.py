"""The encoders' loss: the precomputed classes of the camera, carried to lidar and radar points by a guess.

Lidar semantics are not needed: a point takes the class of the image cell that it falls into. A wrong guess blurs these
labels, but over a fleet it does not bias them. Once the network's own estimate is better than the day's prior, it is
the better guess.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.network.outputs import Predictions
from pipeline.learn.network.rendering import grid_cells, sphere
from pipeline.learn.sample.grid import Grid
from pipeline.objective.differentiable.poses import transform_points
from schemas.training import UNKNOWN_CLASS

__all__ = ["class_of_points", "semantics_loss"]

_RADAR_WEIGHT = 0.2  # a detection's features hardly determine its class


def class_of_points(
    grid_class: UInt8[Tensor, "B H W"],
    points_camera: Float[Tensor, "B N 3"],
    valid: Bool[Tensor, "B N"],
    grid: Grid,
) -> Int64[Tensor, "B N"]:
    """Class of the cell that each point falls into; UNKNOWN_CLASS outside the grid."""
    row, column = grid_cells(sphere(points_camera), grid)
    inside = valid & (points_camera[..., 2] > 0.5) & (row >= 0) & (column >= 0)
    inside = inside & (row < grid.height) & (column < grid.width)
    cell = torch.where(inside, row.long() * grid.width + column.long(), 0)
    found = grid_class.flatten(1).long().gather(1, cell)
    return torch.where(inside, found, UNKNOWN_CLASS)


def semantics_loss(
    predictions: Predictions,
    grid_class: UInt8[Tensor, "B H W"],
    lidar_xyz_m: Float[Tensor, "B N 3"],
    lidar_valid: Bool[Tensor, "B N"],
    T_camera_lidar: Float[Tensor, "B 4 4"],
    grid: Grid,
    radar_camera: Float[Tensor, "B M 3"] | None = None,
    radar_valid: Bool[Tensor, "B M"] | None = None,
) -> Float[Tensor, ""]:
    """Cross-entropy of all encoders that the predictions come from; 0 for networks without any.

    Args:
        predictions: of one pass.
        grid_class: the camera's classes on the network's grid (cropped as its image was).
        lidar_xyz_m: points as in SensorInputs.
        lidar_valid: which of them are real.
        T_camera_lidar: the guess that carries classes to points: the day's prior, or the network's own estimate.
        grid: the network's.
        radar_camera: detections in the optical frame, by such a guess; needed where radar logits exist.
        radar_valid: which of them are real.
    """
    loss = torch.zeros((), device=lidar_xyz_m.device)
    if predictions.camera_logits is not None:
        loss = loss + _cross_entropy(predictions.camera_logits, grid_class.long())
    if predictions.lidar_logits is not None:
        loss = loss + _cross_entropy(
            predictions.lidar_logits,
            _lidar_target(predictions, grid_class, lidar_xyz_m, lidar_valid, T_camera_lidar, grid),
        )
    if predictions.radar_logits is not None:
        assert radar_camera is not None
        assert radar_valid is not None
        target = class_of_points(grid_class, radar_camera, radar_valid, grid)
        loss = loss + _RADAR_WEIGHT * _cross_entropy(predictions.radar_logits.transpose(1, 2), target)
    return loss


def _lidar_target(
    predictions: Predictions, grid_class: Tensor, xyz: Tensor, valid: Tensor, T: Tensor, grid: Grid
) -> Tensor:
    """B H W: the class of the point that each cell shows."""
    of_point = class_of_points(grid_class, transform_points(T.detach(), xyz), valid, grid)
    index = predictions.lidar_index
    target = of_point.gather(1, index.clamp(min=0))
    return torch.where(index >= 0, target, UNKNOWN_CLASS).reshape(-1, grid.height, grid.width)


def _cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    known = (target != UNKNOWN_CLASS).sum().clamp(min=1)
    return F.cross_entropy(logits.float(), target, ignore_index=UNKNOWN_CLASS, reduction="sum") / known
