"""Lidar and radar points on the camera's grid at a guess: for training; inference uses compiled_rendering.

Per cell the nearest point wins. Both versions decide by the same integer key, so they agree wherever the cell
of a point is the same: all but points within 1e-5 cells of a border.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import INDEX_BITS, MILLIMETRES, NEAR_M

__all__ = ["grid_cells", "nearest_points", "paint", "sphere"]


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
    return (
        (np.radians(grid.top_deg) - angles[..., 1]) / cell,
        (np.radians(grid.left_deg) - angles[..., 0]) / cell,
    )


def nearest_points(
    points_camera: Float[Tensor, "B N 3"], valid: Bool[Tensor, "B N"], grid: Grid
) -> Int64[Tensor, "B HW"]:
    """Index of the nearest point in each cell (row by row), -1 if the cell is empty."""
    height, width = grid.height, grid.width
    angles = sphere(points_camera)
    row, column = grid_cells(angles, grid)
    inside = valid & (points_camera[..., 2] > NEAR_M) & (row >= 0) & (column >= 0)
    inside = inside & (row < height) & (column < width)
    cell = torch.where(inside, row.long() * width + column.long(), height * width)
    number = torch.arange(points_camera.shape[1], device=cell.device)
    key = ((angles[..., 2] * MILLIMETRES).long() << INDEX_BITS) | number
    empty = torch.iinfo(torch.int64).max
    cells = torch.full((len(cell), height * width + 1), empty, dtype=torch.int64, device=points_camera.device)
    nearest = cells.scatter_reduce(1, cell, key, "amin")[:, :-1]
    return torch.where(nearest == empty, -1, nearest & ((1 << INDEX_BITS) - 1))


def paint(
    index: Int64[Tensor, "B HW"], values: Float[Tensor, "B N C"], grid: Grid
) -> Float[Tensor, "B C H W"]:
    """Values of the points that won their cells, 0 in empty cells."""
    picked = values.gather(1, index.clamp(min=0)[..., None].expand(-1, -1, values.shape[-1]))
    painted = picked * (index >= 0)[..., None].to(values.dtype)
    return painted.transpose(1, 2).reshape(len(values), values.shape[-1], grid.height, grid.width)
