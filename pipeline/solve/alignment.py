"""Alignment costs of frames at a pose: what held-out frames are judged by, whatever the method.

The judge is the same for all methods: the sharp edges and road markings of method `joint` for camera-lidar,
its registration likelihood for lidar-radar, azimuths of moving clusters against road users' boxes for
camera-radar. The paper's losses can't judge: their minimum lies off the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipeline.objective.problem import Prior
from pipeline.solve.camera_lidar import camera_lidar_cost
from pipeline.solve.camera_radar import camera_radar_cost
from pipeline.solve.lidar_radar import lidar_radar_cost
from schemas.observations import Observation

__all__ = ["Alignment", "alignment_of"]

# (T of the pair, time offset of the pair [s]) -> cost per frame, NaN where a frame cannot tell; lower is
# better.
Alignment = Callable[[np.ndarray, float], np.ndarray]


def alignment_of(pair: str, observations: Sequence[Observation], prior: Prior) -> Alignment:
    """The alignment cost of frames that took no part in the fit.

    Args:
        pair: camera_lidar, camera_radar or lidar_radar.
        observations: the held-out frames.
        prior: turns the radar's own velocity into lidar axes, for time offsets.
    """

    def camera_lidar(T: np.ndarray, dt_s: float) -> np.ndarray:
        told = np.array([len(o.lidar_edge_xyz_m) + len(o.marking_xyz_m) > 0 for o in observations])
        return np.where(
            told, camera_lidar_cost(observations, T, dt_s, T_lidar_radar=prior.T_lidar_radar), np.nan
        )

    def lidar_radar(T: np.ndarray, dt_s: float) -> np.ndarray:
        return lidar_radar_cost(observations, T, dt_s)

    def camera_radar(T: np.ndarray, _dt_s: float) -> np.ndarray:
        return camera_radar_cost(observations, T)

    return {"camera_lidar": camera_lidar, "lidar_radar": lidar_radar, "camera_radar": camera_radar}[pair]
