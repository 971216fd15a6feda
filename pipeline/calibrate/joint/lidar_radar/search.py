"""Search for lidar-radar: a scan about the vertical, annealed Newton steps, accelerated last steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.lidar_radar.normal_equations import linearise
from pipeline.calibrate.joint.lidar_radar.problem import (
    DT,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
)
from pipeline.calibrate.joint.lidar_radar.schedule import SCHEDULE
from pipeline.calibrate.joint.lidar_radar.time_offset import scan_time_offset
from pipeline.calibrate.numerics.bias_floors import OUTLIER_DENSITY
from pipeline.core.config import SolveConfig
from pipeline.objective.radar.registration import BOUNCE_PRIOR, SIGMA_START, registration_cost, updated_sigma
from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = ["NONE_FIXED", "anneal", "finish", "last_step", "scan"]

NONE_FIXED = np.zeros(UNKNOWNS, bool)
_ONLY_DT = np.arange(UNKNOWNS) == DT
_DT_STEP_S, _LEAST_DT_S = 0.01, 2e-5  # longest step, and shortest from which a slope is measured
_FLATNESS = (0.03, 1.5)
_SCAN_STEP_RAD = np.radians(SCHEDULE.scan_step_deg)


def scan(problem: RadarProblem, config: SolveConfig) -> list[RadarState]:
    """The prior, and the best rotation about the vertical that is not next to it, by the wide cost of a few frames."""
    reach = np.radians(max(config.search_rotation_deg, SCHEDULE.scan_least_deg)) * SCHEDULE.scan_reach
    turns = np.arange(-np.ceil(reach / _SCAN_STEP_RAD), np.ceil(reach / _SCAN_STEP_RAD) + 1) * _SCAN_STEP_RAD
    few = np.unique(np.linspace(0, problem.frames.count - 1, SCHEDULE.scan_frames).astype(int))
    part = problem.frames.subset(few)
    sigma = SIGMA_START * np.array(SCHEDULE.scan_widen)
    T0 = problem.prior.T_lidar_radar
    poses = [
        from_rotation_translation(exp_so3(np.array([0.0, 0.0, a])) @ T0[:3, :3], T0[:3, 3]) for a in turns
    ]
    cost = [
        float(registration_cost(part, T, 0.0, sigma, OUTLIER_DENSITY, SCHEDULE.stride).mean()) for T in poses
    ]
    best = int(np.argmin(cost if "static" in problem.terms else np.abs(turns)))
    chosen = [best] if abs(turns[best]) < 0.5 * _SCAN_STEP_RAD else [best, int(np.argmin(np.abs(turns)))]
    return [RadarState(poses[k], 0.0, 0.0, SIGMA_START.copy(), BOUNCE_PRIOR) for k in chosen]


def anneal(problem: RadarProblem, state: RadarState) -> RadarState:
    """Newton steps with re-association at every step, from wide sigmas to the radar's own.

    `problem` may be a part of the day: this finds the basin, `finish` its minimum.
    """
    valley = _Valley()
    for k in range(SCHEDULE.anneal_steps):
        widen = max(1.0, SCHEDULE.widest * SCHEDULE.cooling**k)
        linear = linearise(problem, state, widen, stride=SCHEDULE.stride)
        if k in SCHEDULE.dt_scans:
            state, valley = scan_time_offset(problem, state, SCHEDULE.dt_scans[k]), _Valley()
        # Where sigmas are wide, dt would only wander: x shifts detections as it does.
        fixed = _ONLY_DT if widen > 1.0 else NONE_FIXED
        em_share = SCHEDULE.wide_em_share if widen > 1.0 else SCHEDULE.sharp_em_share
        step, valley = _next_step(linear, state, valley, em_share, fixed)
        state = state.moved(step)
        if widen == 1.0:
            state, valley = _sharpened(linear, state), valley.forgetting()
    return state


def finish(
    problem: RadarProblem,
    state: RadarState,
    fixed: Bool[np.ndarray, " P"] = NONE_FIXED,
    sharpen: bool = False,
) -> tuple[RadarState, Linear]:
    """Steps with all detections until convergence, and the equations there.

    Unknowns in `fixed` keep the prior's value; with `sharpen` the radar's sigmas follow the residuals.
    """
    state = state.with_fixed(problem.prior, fixed)
    valley = _Valley()
    for k in range(SCHEDULE.final_steps):
        linear = linearise(problem, state, 1.0)
        step, valley = _next_step(linear, state, valley, SCHEDULE.final_em_share, fixed)
        state = state.moved(step).with_fixed(problem.prior, fixed)
        converged = np.max(np.abs(step) / STEP_LIMIT) < SCHEDULE.converged
        due = converged or k % SCHEDULE.sharpen_every == SCHEDULE.sharpen_every - 1
        if sharpen and k < SCHEDULE.final_steps // 2 and due:
            before = state.sigma
            state, valley = _sharpened(linear, state), valley.forgetting()
            change = np.max(np.abs(state.sigma / before - 1))
            converged = converged and change < SCHEDULE.sigmas_converged
        if converged:
            break
    return state, linearise(problem, state, 1.0)


def _sharpened(linear: Linear, state: RadarState) -> RadarState:
    sigma, bounce = updated_sigma(linear.registration, state.sigma, state.bounce)
    return replace(state, sigma=sigma, bounce=bounce)


@dataclass(frozen=True)
class _Valley:
    """Curvature of the cost along dt from past steps, with all other unknowns at their optimum."""

    dt_s: float | None = None
    gradient: float = 0.0
    flatness: float = 1.0  # curvature seen, as a share of what soft assignment predicts

    def forgetting(self) -> _Valley:
        """The valley with its curvature alone: the gradient was computed with other sigmas."""
        return replace(self, dt_s=None)

    def seen(self, dt_s: float, gradient: float, predicted: float) -> _Valley:
        """The valley with one more point."""
        flatness = self.flatness
        if self.dt_s is not None and abs(dt_s - self.dt_s) > _LEAST_DT_S:
            flatness = float(np.clip((gradient - self.gradient) / (dt_s - self.dt_s) / predicted, *_FLATNESS))
        return _Valley(dt_s, gradient, flatness)


def _next_step(
    linear: Linear,
    state: RadarState,
    valley: _Valley,
    em_share: float,
    fixed: Bool[np.ndarray, " P"],
) -> tuple[Float[np.ndarray, " P"], _Valley]:
    """EM's step (`em_share` 1), or nearly Newton's with the information that soft assignment leaves (near 0).

    On days of one speed dt, x and the range bias share a valley that is far flatter than either predicts:
    along dt, with the others at their optimum, the step is the secant's.
    """
    H = em_share * linear.H.sum(0) + (1 - em_share) * linear.information.sum(0) + linear.prior_information
    g = linear.g.sum(0) + linear.prior_gradient
    step, others = np.zeros(UNKNOWNS), ~fixed
    others[DT] = False
    solved = np.linalg.solve(H[np.ix_(others, others)], np.stack([g[others], H[others, DT]], 1))
    if not fixed[DT]:
        predicted = float(H[DT, DT] - H[DT, others] @ solved[:, 1])
        gradient = float(g[DT] - H[DT, others] @ solved[:, 0])
        valley = valley.seen(state.dt_s, gradient, predicted)
        move = -gradient / (predicted * valley.flatness)
        step[DT] = np.clip(move, -_DT_STEP_S, _DT_STEP_S)
    step[others] = -(1 + 0.5 * em_share) * solved[:, 0] - solved[:, 1] * step[DT]
    return step / max(1.0, float(np.max(np.abs(step) / STEP_LIMIT))), valley


def last_step(linear: Linear, state: RadarState, fixed: Bool[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """The remaining step with soft assignment."""
    return _next_step(linear, state, _Valley(), SCHEDULE.final_em_share, fixed)[0]
