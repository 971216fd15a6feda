"""Horizontal position of the radar from the day alone, without its prior; for an alarm, not an estimate.

While a car drives, x has the same effect on detections as the time offset, so a day of few speeds leaves x at
the prior. A prior half a metre wrong is then hidden: the time offset compensates it by .05 s, and azimuths
change by .2 deg. But frames of other speeds contradict this. So x, y and the time offset are solved again
without the prior of position.

This alone would raise false alarms. If the car keeps one speed, the three unknowns move along their valley,
by .8 m on a simulated motorway, because the cost has a slope along the direction of travel that is unrelated
to time. A true optimum is a dip: the frames align better there than at the prior, and better than at the same
distance beyond.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from pipeline.calibrate.joint.lidar_radar.measured_curvature import with_measured_curvature
from pipeline.calibrate.joint.lidar_radar.problem import DT, RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.search import finish
from pipeline.calibrate.joint.lidar_radar.time_offset import comparison_cost
from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.rig.changes import change_between

__all__ = ["own_position"]

_ANYWHERE_M = 1.0  # sigma of the position where its prior is left out
_GROUND = {3: "x", 4: "y"}  # of the pose's six


def own_position(
    problem: RadarProblem,
    state: RadarState,
    fixed: Bool[np.ndarray, " P"],
    block: Int64[np.ndarray, " F"],
) -> dict[str, float]:
    """Shift from the prior along each ground axis that was fixed, its sigma, and its significance.

    Returns by name `own_tx_m`, `own_tx_sigma_m` (or ty), and the normal deviates by which frames align better
    there than at the prior (`own_z_prior`) and as far beyond (`own_z_beyond`); empty if the day determined
    both axes.
    """
    asked = [k for k in _GROUND if fixed[k]]
    if not asked:
        return {}
    free = fixed & ~np.isin(np.arange(len(fixed)), [*asked, DT])
    anywhere = replace(problem, prior=replace(problem.prior, translation_sigma_m=_ANYWHERE_M))
    there, linear = finish(anywhere, state, free)
    use = ~free
    information = with_measured_curvature(anywhere, there, linear.information)[:, use][:, :, use]
    covariance = bootstrap_covariance(
        information,
        linear.g[:, use],
        linear.prior_information[np.ix_(use, use)],
        block,
        np.random.default_rng(0),
    )
    sigma = np.zeros(len(fixed))
    sigma[use] = np.sqrt(np.diag(covariance))
    shift = change_between(problem.prior.T_lidar_radar, there.T_lidar_radar)
    found = {f"own_t{_GROUND[k]}_m": float(shift[k]) for k in asked}
    found |= {f"own_t{_GROUND[k]}_sigma_m": float(sigma[k]) for k in asked}
    beyond = problem.prior.T_lidar_radar.copy()
    beyond[:3, 3] += 2 * np.where(np.isin(np.arange(3, 6), asked), shift[3:6], 0.0)
    mirrored = replace(problem, prior=replace(problem.prior, T_lidar_radar=beyond))
    others = {"prior": state, "beyond": finish(mirrored, there, fixed)[0]}
    block = block[problem.frames.frame]
    own = comparison_cost(problem, there)
    return found | {f"own_z_{n}": _z(own - comparison_cost(problem, s), block) for n, s in others.items()}


def _z(difference: Float[np.ndarray, " F"], block: Int64[np.ndarray, " F"]) -> float:
    """Normal deviate of a mean that is 0 where neither is better; negative = lower."""
    sums = np.bincount(block, difference)
    return float(sums.sum() / max(float(np.sqrt(np.sum(sums**2))), 1e-12))
