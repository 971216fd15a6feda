"""Observability of lidar-radar: the degrees of freedom that the day determines, and their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from pipeline.calibrate.joint.lidar_radar.elevation_errors import contradiction, following_tilt, own_numbers
from pipeline.calibrate.joint.lidar_radar.normal_equations import planar_gradient
from pipeline.calibrate.joint.lidar_radar.problem import (
    AZIMUTH_RANGE_DOF,
    DT,
    ELEVATION_DOF,
    RANGE,
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
    comparison_cost,
    finish,
    last_step,
)
from pipeline.calibrate.numerics.covariance import OBSERVABLE, bootstrap_covariance, covariance_with_fixed
from pipeline.calibrate.numerics.frame_blocks import blocks_of
from pipeline.calibrate.numerics.nuisances import (
    LIDAR_RADAR_BIAS,
    LIDAR_RADAR_DT_FLOOR_S,
    RADAR_ELEVATION_BIAS_RAD,
    RANGE_BIAS_SIGMA_M,
    Considered,
    PartTurn,
    considered_covariance,
    considered_numbers,
    root_rows,
)
from pipeline.calibrate.reasons import because
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import prior_share
from pipeline.rig.se3 import change_between

__all__ = [
    "ObservabilityAnalysis",
    "analyse_observability",
    "diagnostics_of",
    "notes_of",
    "own_position",
    "with_measured_curvature",
]

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


# --------------------------------------------------------------------------------------------------
# Conclusions about a lidar-radar solution other than the pose: the radar's own position, numbers, notes.

# --------------------------------------------------------------------------------------------------
# Horizontal position of the radar from the day alone, without its prior; for an alarm, not an estimate.
#
# While a car drives, x has the same effect on detections as the time offset, so a day of few speeds leaves x at
# the prior. A prior half a metre wrong is then hidden: the time offset compensates it by .05 s, and azimuths
# change by .2 deg. But frames of other speeds contradict this. So x, y and the time offset are solved again
# without the prior of position.
#
# This alone would raise false alarms. If the car keeps one speed, the three unknowns move along their valley,
# by .8 m on a simulated motorway, because the cost has a slope along the direction of travel that is unrelated
# to time. A true optimum is a dip: the frames align better there than at the prior, and better than at the same
# distance beyond.


_ANYWHERE_M = 1.0  # sigma of the position where its prior is left out
_GROUND = {3: "x", 4: "y"}  # of the pose's six


def own_position(
    problem: RadarProblem, state: RadarState, fixed: Bool[np.ndarray, " P"], block: Int64[np.ndarray, " F"]
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


# --------------------------------------------------------------------------------------------------
# Conclusions about a lidar-radar solution other than the pose: its data, its assumptions, numbers for checks.


_DT_UNSURE_S = 0.005  # a time offset known no better than this gets a note
_NAMES = np.array(["roll", "pitch", "yaw", "x", "y", "z"])


def notes_of(analysis: ObservabilityAnalysis) -> list[str]:
    """Notes on undetermined unknowns and on assumptions."""
    fixed, heights = analysis.fixed, analysis.problem.heights
    notes = []
    if fixed[:6].any():
        notes.append(because("at the prior", axes=", ".join(_NAMES[fixed[:6]])))
    dt_sigma_s = float(np.sqrt(analysis.covariance[DT, DT]))
    if fixed[DT]:
        notes.append(because("no clock"))
    elif dt_sigma_s > _DT_UNSURE_S:
        notes.append(because("clock unsure", ms=1e3 * dt_sigma_s))
    notes.append(because("no boxes"))
    if _travel_frames(analysis):
        notes.append(because("parallel"))
    if heights is not None:
        sigma = np.degrees(heights.floor_rad)
        notes.append(because("mirror images", share=heights.displaced, sigma=sigma))
    disagreement = contradiction(analysis.sources)
    if disagreement is not None:
        notes.append(disagreement.sentence)
    bias_sigma_m = float(np.sqrt(analysis.covariance[RANGE, RANGE]))
    if analysis.problem.frames.has_elevation.any():
        notes.append(because("own elevation", sigma=np.degrees(RADAR_ELEVATION_BIAS_RAD)))
    else:
        notes.append(because("no elevation"))
    sigmas = {"sigma": bias_sigma_m, "prior": RANGE_BIAS_SIGMA_M}
    return [*notes, because("range bias", bias=analysis.state.range_bias_m, **sigmas)]


def diagnostics_of(analysis: ObservabilityAnalysis) -> dict[str, float]:
    """Numbers of a solution; non-finite values are left out."""
    state, linear, heights = analysis.state, analysis.linear, analysis.problem.heights
    diagnostics = {
        "azimuth_sigma_rad": float(state.sigma[0]),
        "elevation_sigma_rad": float(state.sigma[1]),
        "range_sigma_m": float(state.sigma[2]),
        "range_bias_m": state.range_bias_m,
        "range_bias_sigma_m": float(np.sqrt(analysis.covariance[RANGE, RANGE])),
        "bounce_share": state.bounce,
        **({} if heights is None else {"displaced_share": heights.displaced}),
        "assigned_share": float(linear.registration.assigned.mean()),
        "moving_azimuth_sigma_rad": linear.mover_sigma_rad,
        **own_numbers(analysis.sources),
        **considered_numbers(analysis.considered, of_camera=False),
        "doppler_frames": float(_travel_frames(analysis)),
        "doppler_scatter_rad": linear.travel_scatter_rad,
    }  # fmt: skip
    return {k: v for k, v in diagnostics.items() if np.isfinite(v)}


def _travel_frames(analysis: ObservabilityAnalysis) -> int:
    """Number of frames by whose direction of travel pitch is known."""
    travel = analysis.problem.travel
    is_asked = any(source.name == "doppler" for source in analysis.sources)
    return travel.count if travel is not None and is_asked else 0
