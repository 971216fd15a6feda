"""Observability of lidar-radar: the degrees of freedom that the day determines, and their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.calibrate.joint.lidar_radar.elevation_errors import following_tilt
from pipeline.calibrate.joint.lidar_radar.normal_equations import planar_gradient
from pipeline.calibrate.joint.lidar_radar.problem import (
    AZIMUTH_RANGE_DOF,
    DT,
    ELEVATION_DOF,
    SEEN_LOW,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
)
from pipeline.calibrate.joint.lidar_radar.search import (
    NONE_FIXED,
    OtherOffsets,
    better_time_offset,
    finish,
    last_step,
)
from pipeline.calibrate.joint.part_turn import PartTurn
from pipeline.calibrate.numerics.bias_floors import LIDAR_RADAR_BIAS, LIDAR_RADAR_DT_FLOOR_S
from pipeline.calibrate.numerics.covariance import OBSERVABLE, covariance_with_fixed
from pipeline.calibrate.numerics.frame_blocks import blocks_of
from pipeline.calibrate.numerics.nuisances import Considered, considered_covariance, root_rows
from pipeline.core.config import SolveConfig
from pipeline.rig.common_share import prior_share

__all__ = ["ObservabilityAnalysis", "analyse_observability", "with_measured_curvature"]

# --------------------------------------------------------------------------------------------------
# The cost's own curvature over yaw, x, y, dt and range bias, where soft assignment predicts too much of it.


_MEASURED_SHARE = (0.02, 1.0)  # range of the measured curvature, as a share of the predicted one


def with_measured_curvature(
    problem: RadarProblem, state: RadarState, information: Float[np.ndarray, "F P P"]
) -> Float[np.ndarray, "F P P"]:
    """Information with the cost's measured curvature over yaw, x, y, dt and range bias.

    On days of one speed, x, dt and the range bias share a valley that is far flatter than soft assignment
    predicts.
    """
    dof = AZIMUTH_RANGE_DOF
    total = information.sum(0)[np.ix_(dof, dof)]
    measured = np.zeros_like(total)
    for column, k in enumerate(dof):
        step = np.zeros(UNKNOWNS)
        step[k] = 0.05 * STEP_LIMIT[k]
        ahead, behind = (planar_gradient(problem, state.moved(s)) for s in (step, -step))
        measured[:, column] = (ahead - behind) / (2 * step[k])
    # A standing car has no information on dt: what is added is far below any prior.
    L = np.linalg.cholesky(total + np.diag(1e-3 / STEP_LIMIT[dof] ** 2))
    W = np.linalg.solve(L, np.linalg.solve(L, 0.5 * (measured + measured.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = L @ vectors
    out = information.copy()
    out[np.ix_(np.arange(len(out)), dof, dof)] += (
        (root * np.clip(values, *_MEASURED_SHARE)) @ root.T - total
    ) / len(out)
    return out


# --------------------------------------------------------------------------------------------------
# Observability analysis of lidar-radar: the degrees of freedom that the day determines, and their covariance.


_REMAINING_STEPS = 10.0  # of dt, that count as uncertainty: the valley is flat


@dataclass(frozen=True, eq=False)
class ObservabilityAnalysis:
    """The solution in which every unknown is either determined by the day or fixed at the prior."""

    state: RadarState
    linear: Linear
    covariance: np.ndarray  # P P, of all unknowns, turns about the radar
    common: np.ndarray  # P P, of the covariance what all days of a vehicle err by alike
    considered: tuple[Considered, ...]  # of the common part what is no prior's
    of_scenes: np.ndarray  # P P, of the covariance what all frames of the day err by alike
    fixed: np.ndarray  # P, bool
    observability: np.ndarray  # 7, of pose and dt
    problem: RadarProblem
    sources: tuple[PartTurn, ...] = ()  # of pitch, asked where the car's way had no say yet
    dt_weight: float = 1.0  # of the day's time offset against the expected one


def analyse_observability(
    problem: RadarProblem, state: RadarState, config: SolveConfig, rng: np.random.Generator
) -> ObservabilityAnalysis:
    """Solve, fix what the day did not determine, and solve again until nothing more has to be fixed."""
    block = blocks_of(problem.observations, config.bootstrap_blocks)
    before = np.append(np.diag(problem.prior.covariance("lidar_radar")), problem.dt_sigma_s**2)
    fixed, observability = NONE_FIXED.copy(), np.ones(DT + 1)
    while True:
        if fixed.any() and not fixed[DT]:
            # While free, x had followed dt through their valley; with x back at the prior, dt may be out of reach.
            state = state.with_fixed(problem.prior, fixed)
            state = better_time_offset(OtherOffsets(problem, state)) or state
        # Once the radar's sigmas are estimated they stay, so that solutions can be compared.
        sharpen = problem.travel is None and problem.heights is None and not fixed.any()
        state, linear = finish(problem, state, fixed, sharpen=sharpen)
        full, variance, curvature, follow = _covariance(problem, state, linear, fixed, before, block, rng)
        free = ~fixed[: DT + 1]
        dt_bias = LIDAR_RADAR_DT_FLOOR_S**2 + _remaining_dt(linear, state, fixed) ** 2
        bias = np.where(free, [*LIDAR_RADAR_BIAS**2, dt_bias], 0.0)
        removed = _observability(np.diag(full)[: DT + 1], bias, before)
        observability[free] = removed[free]
        if np.all(removed[free] >= OBSERVABLE):
            break
        unknown = removed < OBSERVABLE
        # Where x and dt look alike, neither is determined while both are free, and one is once the other is fixed. Both
        # fixed, they contradict the scene by metres, and yaw follows.
        unknown[DT] &= not np.any(unknown[:DT] & ~fixed[:DT])
        fixed[: DT + 1] |= unknown
    floors, alike = (
        follow @ _left_by(scatter, curvature, fixed) @ follow.T
        for scatter in (linear.floors, linear.floors_alike)
    )
    sigmas = np.diag(np.append(np.sqrt(bias), np.zeros(UNKNOWNS - len(bias))))
    added = Considered("surfaces", sigmas[:DT]), Considered("clock", sigmas[[DT]])
    # How low things are seen is the radar's and its roads': it is no less a bias for being estimated.
    seen_low = full[[SEEN_LOW]] / np.sqrt(variance[SEEN_LOW])
    weighted = (
        Considered("elevations", root_rows(alike), in_weights=True),
        Considered("seen_low", seen_low, in_weights=True),
    )
    others = np.arange(len(variance)) != SEEN_LOW
    of_prior = prior_share(full, np.diag(others / variance))
    return ObservabilityAnalysis(
        state,
        linear,
        full + considered_covariance(added),
        of_prior + considered_covariance([*added, *weighted]),
        (*added, *weighted),
        floors + considered_covariance(added),
        fixed,
        observability,
        problem,
    )


def _covariance(
    problem: RadarProblem,
    state: RadarState,
    linear: Linear,
    fixed: Bool[np.ndarray, " P"],
    before: Float[np.ndarray, " D"],
    block: Int[np.ndarray, " F"],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariance without bias floors, variance of the prior, curvature, and what follows errors of the tilts."""
    information = with_measured_curvature(problem, state, linear.information)
    curvature = information.sum(0) + linear.prior_information
    variance = 1 / np.diag(linear.prior_information)
    variance[: DT + 1] = np.where(fixed[: DT + 1], before, variance[: DT + 1])
    full = covariance_with_fixed(information, linear.g, variance, curvature, fixed, block, rng)
    follow = _following_tilt(linear, fixed)
    return follow @ full @ follow.T, variance, curvature, follow


def _following_tilt(linear: Linear, fixed: Bool[np.ndarray, " P"]) -> Float[np.ndarray, "P P"]:
    """Dependence of yaw, x, y, dt and range bias on errors of roll, pitch, z, which are fixed in their equations."""
    H = np.zeros_like(linear.prior_information)
    H[:8, :8] = linear.registration.H[0].sum(0)
    follows = AZIMUTH_RANGE_DOF[~fixed[AZIMUTH_RANGE_DOF]]
    return following_tilt(H, linear.prior_information, follows, ELEVATION_DOF)


def _left_by(
    scatter: Float[np.ndarray, "P P"], curvature: Float[np.ndarray, "P P"], fixed: Bool[np.ndarray, " P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance of the free unknowns from the scatter of the total gradient."""
    out, free = np.zeros_like(curvature), np.ix_(~fixed, ~fixed)
    follow = np.linalg.inv(curvature[free])
    out[free] = follow @ scatter[free] @ follow.T
    return out


def _observability(variance: np.ndarray, bias: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Fraction of prior variance removed, bias floor included.

    Args:
        variance: variance of the estimate, day and prior together, without bias.
        bias: squared bias floor of the day's information.
        before: variance of the prior.
    """
    # The floor is an error of the day's information alone: it does not widen the prior.
    day = 1 / np.maximum(1 / variance - 1 / before, 1e-9 / before) + bias
    return before / (before + day)


def _remaining_dt(linear: Linear, state: RadarState, fixed: np.ndarray) -> float:
    """Ten times the next step of dt [s], because many small steps may follow in a flat valley."""
    return float(_REMAINING_STEPS * last_step(linear, state, fixed)[DT])
