"""Normal equations of lidar-radar: which term contributes to which degree of freedom, and the prior.

Which term determines which degree of freedom is chosen here, for measured reasons: azimuth and range of the static
registration determine yaw, x, y and dt; moving clusters add azimuth. Elevations (`elevation_terms`) contribute to roll,
pitch and z. The prior keeps what is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.elevation_terms import (
    add_elevations,
    add_heights,
    add_travel,
    turned,
)
from pipeline.calibrate.joint.lidar_radar.problem import (
    AZIMUTH_RANGE_DOF,
    DT,
    RANGE,
    SEEN_LOW,
    UNKNOWNS,
    UNUSED,
    Linear,
    RadarProblem,
    RadarState,
    Sums,
)
from pipeline.calibrate.numerics.bias_floors import (
    OUTLIER_DENSITY,
    PRIOR_CONTRADICTION_SIGMAS,
    RANGE_BIAS_SIGMA_M,
)
from pipeline.objective.radar.moving_clusters import azimuth_equations_lidar
from pipeline.objective.radar.registration import NormalEquations, normal_equations
from pipeline.objective.radar.vehicle_boxes import BIAS_SIGMA_RAD
from pipeline.rig.changes import change_between, change_jacobian

__all__ = ["linearise", "planar_gradient"]


def linearise(problem: RadarProblem, state: RadarState, widen: float, stride: int = 1) -> Linear:
    """Associate at a state and linearise all terms.

    Args:
        problem: the day.
        state: where.
        widen: of the registration's sigmas; only at 1 do moving clusters take part.
        stride: use every n-th static detection.
    """
    sums, equations, mover_sigma = _planar(problem, state, widen, stride)
    add_elevations(problem, state, equations, stride, sums)
    travel_scatter = add_travel(problem, state, sums)
    add_heights(problem, state, sums)
    return Linear(
        sums.H,
        sums.information,
        sums.g,
        *_prior_equations(problem, state),
        equations,
        mover_sigma,
        travel_scatter,
        sums.floors,
        sums.floors - sums.of_day,
    )


def planar_gradient(problem: RadarProblem, state: RadarState) -> Float[np.ndarray, " A"]:
    """Gradient of the data by AZIMUTH_RANGE_DOF, to which elevations contribute nothing."""
    g: np.ndarray = _planar(problem, state, 1.0, 1)[0].g.sum(0)
    return g[AZIMUTH_RANGE_DOF]


def _planar(
    problem: RadarProblem, state: RadarState, widen: float, stride: int
) -> tuple[Sums, NormalEquations, float]:
    """Equations of yaw, x, y, dt and range bias; all of the registration's; the sigma of movers' azimuths [rad]."""
    sums = Sums.none(len(problem.observations))
    about_radar = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    equations = _registration(problem, state, widen, stride, about_radar)
    _add_azimuths_and_ranges(problem, equations, stride, sums)
    mover_sigma = float("nan")
    if widen == 1.0 and "moving" in problem.terms:  # partners are found only once the clusters lie near them
        mover_sigma = _add_movers(problem, state, about_radar, sums)
    return sums, equations, mover_sigma


def _registration(
    problem: RadarProblem, state: RadarState, widen: float, stride: int, about_radar: np.ndarray
) -> NormalEquations:
    """Equations of the static detections about the radar; zero where `terms` leaves them out."""
    equations = _about_radar(
        about_radar,
        normal_equations(
            problem.frames,
            state.T_lidar_radar,
            state.dt_s,
            state.sigma * widen,
            state.bounce,
            OUTLIER_DENSITY,
            stride,
            state.range_bias_m,
        ),
    )
    if "static" in problem.terms:
        return equations
    return replace(equations, H=0 * equations.H, g=0 * equations.g, information=0 * equations.information)


def _add_azimuths_and_ranges(
    problem: RadarProblem, equations: NormalEquations, stride: int, sums: Sums
) -> None:
    """Yaw, x, y, dt and range bias from the registration's azimuths and ranges."""
    at = problem.frames.frame
    where = np.ix_(at, AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    block = np.ix_(np.arange(len(at)), AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    sums.H[where] += stride * equations.H[0][block]
    sums.information[where] += stride * equations.information[0][block]
    sums.g[np.ix_(at, AZIMUTH_RANGE_DOF)] += stride * equations.g[0][:, AZIMUTH_RANGE_DOF]


def _add_movers(problem: RadarProblem, state: RadarState, about_radar: np.ndarray, sums: Sums) -> float:
    """Add moving clusters; returns the sigma of their azimuths [rad]."""
    H, g, sigma = azimuth_equations_lidar(problem.movers, state.T_lidar_radar, state.dt_s)
    H, g = turned(about_radar, H, g)
    # As with static detections, azimuths determine yaw, x and y; roll would come from heights that clusters lack.
    flat = AZIMUTH_RANGE_DOF[:3]
    for array in (sums.H, sums.information):
        array[np.ix_(np.arange(len(array)), flat, flat)] += H[:, flat[:, None], flat]
    sums.g[:, flat] += g[:, flat]
    return sigma


def _about_radar(about_radar: np.ndarray, equations: NormalEquations) -> NormalEquations:
    H, g = turned(about_radar, equations.H, equations.g)
    return replace(
        equations, H=H, g=g, information=turned(about_radar, equations.information, equations.g)[0]
    )


def _prior_equations(problem: RadarProblem, state: RadarState) -> tuple[np.ndarray, np.ndarray]:
    """Prior on pose (Cauchy: data may contradict it), dt and biases (Gaussian).

    Rotation as a whole and every axis of the position lose weight separately: a z that elevations mislead is no reason
    to trust the prior's x and y less, nor the other way round.
    """
    prior = problem.prior
    x = np.zeros(UNKNOWNS)
    x[:6] = change_between(prior.T_lidar_radar, state.T_lidar_radar)
    x[DT] = state.dt_s
    x[RANGE] = state.range_bias_m
    x[SEEN_LOW] = state.seen_low - problem.seen_low.mean
    weight = np.empty(UNKNOWNS)
    turned = float(x[:3] @ x[:3]) / prior.rotation_sigma_rad**2
    weight[:3] = 1 / prior.rotation_sigma_rad**2 / (1 + turned / PRIOR_CONTRADICTION_SIGMAS**2)
    shifted = (x[3:6] / prior.translation_sigma_m) ** 2
    weight[3:6] = 1 / prior.translation_sigma_m**2 / (1 + shifted / PRIOR_CONTRADICTION_SIGMAS**2)
    weight[DT] = 1 / problem.dt_sigma_s**2
    weight[RANGE] = 1 / RANGE_BIAS_SIGMA_M**2
    weight[UNUSED] = 1 / BIAS_SIGMA_RAD**2
    weight[SEEN_LOW] = 1 / problem.seen_low.sigma**2
    return np.diag(weight), weight * x
