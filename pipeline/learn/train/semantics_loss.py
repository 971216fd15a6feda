"""Loss of the encoders: the camera's precomputed classes, carried to lidar and radar points by the day's reference.

Lidar semantics are not needed: a point takes the class of its image cell.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.network.outputs import Predictions
from pipeline.learn.network.rendering import grid_cells, sphere
from pipeline.learn.sample.grid import Grid
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
    lidar_class: Int64[Tensor, "B N"],
    radar_class: Int64[Tensor, "B M"],
) -> Float[Tensor, ""]:
    """Cross-entropy of all encoders of one pass, 0 without any; `grid_class` is cropped as the image was."""
    loss = torch.zeros((), device=grid_class.device)
    if predictions.camera_logits is not None:
        loss = loss + _cross_entropy(predictions.camera_logits, grid_class.long())
    if predictions.lidar_logits is not None:
        # Each cell has the class of the point that it shows.
        index = predictions.lidar_index
        target = torch.where(index >= 0, lidar_class.gather(1, index.clamp(min=0)), UNKNOWN_CLASS)
        loss = loss + _cross_entropy(predictions.lidar_logits, target.reshape(grid_class.shape))
    if predictions.radar_logits is not None:
        radar = _cross_entropy(predictions.radar_logits.transpose(1, 2), radar_class)
        loss = loss + _RADAR_WEIGHT * radar
    return loss


def _cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    known = (target != UNKNOWN_CLASS).sum().clamp(min=1)
    return F.cross_entropy(logits.float(), target, ignore_index=UNKNOWN_CLASS, reduction="sum") / known
