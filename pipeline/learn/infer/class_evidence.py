"""Camera-lidar evidence of one frame at any pose: classes of lidar points on the camera's class likelihoods.

A network looks at shifts of whole cells within one frame. This module scores the same maps and points at a
pose, with the gradient of the score, so that `joint_day` can use all frames of a day at one pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.learn.sample.grid import NEAR_M, Grid
from schemas.training import GRID_CLASSES

__all__ = ["FrameEvidence"]

_BEHIND = -5.0  # log-likelihood of a point behind the camera: the floor of the maps


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """One frame: a map of log-likelihoods, and lidar points with the probability of their classes.

    Args:
        travel: twist per second of the lidar in its own axes [rad/s, m/s].
        lag_s: by how much later than the sweep the image was taken, by their stamps.
    """

    grid: Grid
    maps: Float32[np.ndarray, "H W K"]
    points_m: Float32[np.ndarray, "N 3"]  # lidar frame
    probability: Float32[np.ndarray, "N K"]
    worth: Float32[np.ndarray, " N"]  # 0 = absent
    travel: Float[np.ndarray, " 6"] = field(default_factory=lambda: np.zeros(6))
    lag_s: float = 0.0

    @property
    def kinds(self) -> Int[np.ndarray, " K"]:
        """Kind of evidence of each map: 0 for all classes together, then edges on boundaries, then paint."""
        return np.maximum(np.arange(self.maps.shape[2]) - (len(GRID_CLASSES) - 1), 0)

    def score(
        self, T_camera_lidar: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, " E"], Float[np.ndarray, "E 6"]]:
        """Mean expected log-likelihood of the points by kind, and its gradient by a left twist (per rad, per m)."""
        kinds, grid = self.kinds, self.grid
        value, gradient = np.zeros(kinds[-1] + 1), np.zeros((kinds[-1] + 1, 6))
        limits = np.radians([grid.top_deg, grid.left_deg, grid.cell_deg])
        given = self.points_m, self.probability, self.worth, self.maps
        _score(*given, T_camera_lidar[:3], limits, kinds, value, gradient)
        return value, gradient


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _score(points, probability, worth, maps, T, limits, kinds, value, gradient):  # noqa: ANN001, ANN202 - compiled
    height, width, classes = maps.shape
    cell = limits[2]
    weight = 0.0
    corners = np.zeros((len(value), 4))  # of the cell that a point lies in, by kind
    for n in range(len(points)):
        w = worth[n]
        if w <= 0:
            continue
        weight += w
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if z <= NEAR_M:
            value[0] += w * _BEHIND
            continue
        flat = np.sqrt(x * x + z * z)
        # Values are at the centres of cells; beyond the outer ones the border value continues.
        row = (limits[0] - np.arctan(-y / flat)) / cell - 0.5
        column = (limits[1] - np.arctan(-x / z)) / cell - 0.5
        row_in, column_in = min(max(row, 0.0), height - 1.0), min(max(column, 0.0), width - 1.0)
        i, j = min(int(row_in), height - 2), min(int(column_in), width - 2)
        below, right = row_in - i, column_in - j
        corners[:] = 0.0
        for k in range(classes):
            p = probability[n, k]
            if p > 0:
                corners[kinds[k], 0] += p * maps[i, j, k]
                corners[kinds[k], 1] += p * maps[i, j + 1, k]
                corners[kinds[k], 2] += p * maps[i + 1, j, k]
                corners[kinds[k], 3] += p * maps[i + 1, j + 1, k]
        squared = flat * flat + y * y
        for e in range(len(value)):
            m00, m01, m10, m11 = corners[e]
            above_value, below_value = m00 + right * (m01 - m00), m10 + right * (m11 - m10)
            value[e] += w * (above_value + below * (below_value - above_value))
            by_row = below_value - above_value if row_in == row else 0.0
            by_column = (m01 - m00) + below * ((m11 - m10) - (m01 - m00)) if column_in == column else 0.0
            # Elevation is arctan(-y / flat), azimuth arctan(-x / z); rows and columns grow against them.
            by_elevation, by_azimuth = -by_row / cell, -by_column / cell
            gx = by_elevation * y * x / (squared * flat) - by_azimuth * z / (flat * flat)
            gy = -by_elevation * flat / squared
            gz = by_elevation * y * z / (squared * flat) + by_azimuth * x / (flat * flat)
            gradient[e, 0] += w * (y * gz - z * gy)
            gradient[e, 1] += w * (z * gx - x * gz)
            gradient[e, 2] += w * (x * gy - y * gx)
            gradient[e, 3] += w * gx
            gradient[e, 4] += w * gy
            gradient[e, 5] += w * gz
    value /= max(weight, 1.0)
    gradient /= max(weight, 1.0)
