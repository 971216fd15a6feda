"""What one frame says of camera-lidar at any pose: classes of lidar points on the camera's map of class likelihoods.

A network looks at shifts of whole cells within one frame. Here the same maps and the same points are scored at a pose,
with the score's gradient, so that all frames of a day can be asked about one pose at a time (`joint_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32

from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import NEAR_M

__all__ = ["FrameEvidence", "scores"]

_BEHIND = -5.0  # log-likelihood of a point behind the camera: the floor of the maps


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """One frame: a map of log-likelihoods, and lidar points with the probability of their classes."""

    grid: Grid
    maps: Float32[np.ndarray, "H W K"]
    points_m: Float32[np.ndarray, "N 3"]  # lidar frame
    probability: Float32[np.ndarray, "N K"]
    worth: Float32[np.ndarray, " N"]  # 0 = absent


def scores(
    frames: Sequence[FrameEvidence], T_camera_lidar: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 6"]]:
    """Mean expected log-likelihood of each frame's points, and its gradient by a twist on the left (per rad, per m)."""
    value, gradient = np.zeros(len(frames)), np.zeros((len(frames), 6))
    T = np.ascontiguousarray(T_camera_lidar[:3], dtype=np.float64)
    for i, f in enumerate(frames):
        limits = np.radians([f.grid.top_deg, f.grid.left_deg, f.grid.cell_deg])
        value[i] = _score(f.points_m, f.probability, f.worth, f.maps, T, limits, gradient[i])
    return value, gradient


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _score(points, probability, worth, maps, T, limits, gradient):  # noqa: ANN001, ANN202 - compiled
    height, width, classes = maps.shape
    cell = limits[2]
    total, weight = 0.0, 0.0
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
            total += w * _BEHIND
            continue
        flat = np.sqrt(x * x + z * z)
        # Values stand at the centres of cells; beyond the outer ones goes on what stands there.
        row = (limits[0] - np.arctan(-y / flat)) / cell - 0.5
        column = (limits[1] - np.arctan(-x / z)) / cell - 0.5
        row_in, column_in = min(max(row, 0.0), height - 1.0), min(max(column, 0.0), width - 1.0)
        i, j = min(int(row_in), height - 2), min(int(column_in), width - 2)
        below, right = row_in - i, column_in - j
        m00 = m01 = m10 = m11 = 0.0
        for k in range(classes):
            p = probability[n, k]
            if p > 0:
                m00 += p * maps[i, j, k]
                m01 += p * maps[i, j + 1, k]
                m10 += p * maps[i + 1, j, k]
                m11 += p * maps[i + 1, j + 1, k]
        above_value, below_value = m00 + right * (m01 - m00), m10 + right * (m11 - m10)
        total += w * (above_value + below * (below_value - above_value))
        by_row = below_value - above_value if row_in == row else 0.0
        by_column = (m01 - m00) + below * ((m11 - m10) - (m01 - m00)) if column_in == column else 0.0
        # Elevation is arctan(-y / flat), azimuth arctan(-x / z); rows and columns grow against them.
        squared = flat * flat + y * y
        by_elevation, by_azimuth = -by_row / cell, -by_column / cell
        gx = by_elevation * y * x / (squared * flat) - by_azimuth * z / (flat * flat)
        gy = -by_elevation * flat / squared
        gz = by_elevation * y * z / (squared * flat) + by_azimuth * x / (flat * flat)
        gradient[0] += w * (y * gz - z * gy)
        gradient[1] += w * (z * gx - x * gz)
        gradient[2] += w * (x * gy - y * gx)
        gradient[3] += w * gx
        gradient[4] += w * gy
        gradient[5] += w * gz
    weight = max(weight, 1.0)
    for k in range(6):
        gradient[k] /= weight
    return total / weight
