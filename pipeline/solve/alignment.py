"""Alignment costs of frames at a pose: what held-out frames are judged by."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipeline.config import SolveConfig
from pipeline.objective.problem import Prior
from pipeline.solve.pairwise import pair_problem
from schemas.observations import Observation

__all__ = ["Alignment", "alignment_of"]

# (T of the pair, time offset of the pair [s]) -> cost per frame, NaN where a frame cannot tell; lower is better.
Alignment = Callable[[np.ndarray, float], np.ndarray]


def alignment_of(
    pair: str, observations: Sequence[Observation], prior: Prior, config: SolveConfig, *, paper: bool
) -> Alignment:
    """The alignment cost of frames that took no part in the fit, prepared once for several poses.

    Args:
        pair: camera_lidar, camera_radar or lidar_radar.
        observations: the held-out frames.
        prior: decides which points are in view.
        config: search range.
        paper: judge by the paper's loss; it knows no time offset.
    """
    problem = pair_problem(pair, observations, prior, config)
    del paper

    def cost(T: np.ndarray, _dt_s: float) -> np.ndarray:
        return np.where(problem.informative, problem.frame_losses(T[None])[0], np.nan)

    return cost
