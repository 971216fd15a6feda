"""Directions of points on the camera's grid, through which gradients flow."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.learn.sample.grid import Grid

__all__ = ["grid_cells", "sphere"]


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
