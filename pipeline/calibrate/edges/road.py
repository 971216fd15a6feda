"""The road under the car, per sweep: height, slope and cross slope in axes of the base.

The fit uses a strip as wide as the car. Beyond it are kerbs and pavements: a plane through all ground within
35 m leaned by 0.1 to 0.4 deg towards the nearer pavement on simulated streets, the strip by 0.03. Along the
way the strip is a parabola, because roads bend; it is evaluated at the base's origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.sweeps import Sweep
from pipeline.rig.se3 import transform_points

__all__ = ["RoadUnder", "road_under"]

_ASIDE_M, _ALONG_M = 1.6, (-12.0, 22.0)
_OFF_M = 0.7  # from where the prior expects the road: what lies further off is no road, or no prior
_CELL_M = (2.0, 0.4)  # stretches of road that count alike: rings crowd near the car
_FEWEST_CELLS, _FEWEST_POINTS = 15, 60
_LEAST_LENGTH_M, _LEAST_WIDTH_M = (
    8.0,
    2.0,
)  # of what is seen: less does not separate slope from bend, or left from right
_FLAT_M = 0.01
_PASSES = 8


@dataclass(frozen=True, eq=False)
class RoadUnder:
    """One road per row: z = height + slope x + cross_slope y + bend x^2 in axes of the base."""

    moment: np.ndarray  # R
    height_m: np.ndarray
    slope: np.ndarray
    cross_slope: np.ndarray


def road_under(sweeps: Sequence[Sweep], T_base_lidar: Float[np.ndarray, "4 4"], road_z_m: float) -> RoadUnder:
    """Fit the road in each sweep that shows enough of it; `T_base_lidar` is good to a few degrees."""
    rows = [
        (float(k), *fit) for k, s in enumerate(sweeps) if (fit := _fit(s, T_base_lidar, road_z_m)) is not None
    ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return RoadUnder(table[:, 0].astype(np.int64), *table[:, 1:].T)


def _fit(sweep: Sweep, T_base_lidar: np.ndarray, road_z_m: float) -> tuple[float, float, float] | None:
    p = transform_points(T_base_lidar, sweep.xyz_m[sweep.is_ground])
    off = np.abs(p[:, 2] - road_z_m) < _OFF_M
    p = p[off & (np.abs(p[:, 1]) < _ASIDE_M) & (p[:, 0] > _ALONG_M[0]) & (p[:, 0] < _ALONG_M[1])]
    if len(p) < _FEWEST_POINTS or (np.ptp(p[:, :2], axis=0) < (_LEAST_LENGTH_M, _LEAST_WIDTH_M)).any():
        return None
    cell = np.floor(p[:, :2] / _CELL_M).astype(np.int64) @ [1000, 1]
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    if len(count) < _FEWEST_CELLS:
        return None
    even = 1 / count[cell]
    x, y, z = p.T
    A = np.stack([np.ones_like(x), x, y, x * x], 1)
    weight, road = even, np.zeros(4)
    for _ in range(_PASSES):
        road = np.linalg.solve((A.T * weight) @ A, (A.T * weight) @ z)
        r = z - A @ road
        sigma = max(1.4826 * float(np.median(np.abs(r))), _FLAT_M)
        weight = even * (1 + (r / (2 * sigma)) ** 2) ** -2
    return float(road[0]), float(road[1]), float(road[2])
