"""Search for lidar-radar: time offset, a scan about the vertical, annealed Newton steps, accelerated last steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from pipeline.calibrate.joint.lidar_radar.normal_equations import linearise
from pipeline.calibrate.joint.lidar_radar.problem import (
    DT,
    SCHEDULE,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
)
from pipeline.calibrate.numerics.nuisances import OUTLIER_DENSITY, REGISTRATION_COMPARISON_SIGMA
from pipeline.core.config import SolveConfig
from pipeline.objective.radar.registration import (
    BOUNCE_PRIOR,
    SIGMA_START,
    RegistrationFrames,
    registration_cost,
    updated_sigma,
)
from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = [
    "NONE_FIXED",
    "OtherOffsets",
    "anneal",
    "better_time_offset",
    "comparison_cost",
    "dips",
    "far_time_offset",
    "finish",
    "last_step",
    "scan",
    "scan_time_offset",
    "time_offset_scatter_s",
]

# --------------------------------------------------------------------------------------------------
# The radar's time offset among many: the one at which the registration's cost dips, not its lowest value.
#
# Along the direction of travel the cost has a slope that is unrelated to time: a cloud has more points near the
# car, so detections moved towards the car match more of them. On a simulated highway (30 m/s, 16 rings) the
# cost fell by half from 0 to -130 ms, and only a dip of three steps marked the true 20 ms. The criterion is
# therefore the cost below that of its surroundings.


_CLEARLY = 4.0  # standard errors by which frames reject the solution's own time offset
# The same at the radar's own sigmas. A corner radar's dt had slid 39 ms along guard rails that seven fast frames of 23
# passed: there 3.5, at the other sigmas 2.1; on 13 right days of seeds 40 to 117 no other offset was deeper at all.
_CLEARLY_BY_OWN, _OWN_STRIDE = 3.0, 3
_FAR_S, _FAR_STRIDE = 1.0, 3  # of an alarm: how far it looks, in one frame of so many
_RESAMPLES = 200


def dips(cost: Float[np.ndarray, "K F"]) -> Float[np.ndarray, "K F"]:
    """Costs at K steps of time less the median of those around them, by frame: 0 on any slope, negative in a dip."""
    around = 2 * SCHEDULE.dt_dip_steps + 1
    return cost - median_filter(cost, size=(around, 1), mode="nearest")


def scan_time_offset(problem: RadarProblem, state: RadarState, widen: float) -> RadarState:
    """The time offset at which most detections meet the lidar, by the medium cost of some frames.

    At 30 m/s 25 ms are 0.75 m: posts and signs are then out of reach of sharp sigmas, and guard rails meet
    themselves.
    """
    frames = problem.frames
    step_s = _step_s(frames, SCHEDULE.dt_scan_step_m)
    count = int(np.ceil(2 * problem.dt_sigma_s / step_s))
    part = frames.subset(np.arange(0, frames.count, 1 + (frames.count > SCHEDULE.scan_frames)))
    offsets = state.dt_s + step_s * np.arange(-count, count + 1)
    detections = max(len(part.radar_m) / SCHEDULE.stride / max(part.count, 1), 1.0)

    def cost(dt_s: float) -> float:
        T, sigma = state.T_lidar_radar, widen * SIGMA_START
        found = registration_cost(part, T, dt_s, sigma, OUTLIER_DENSITY, SCHEDULE.stride, state.range_bias_m)
        return float(found.sum() * detections)

    value = dips(np.array([[cost(float(dt_s))] for dt_s in offsets]))[:, 0]
    value += 0.5 * (offsets / problem.dt_sigma_s) ** 2
    return replace(state, dt_s=float(offsets[int(np.argmin(value))]))


class OtherOffsets:
    """A solution at other time offsets, itself in the middle.

    Args:
        near: which of them are within two sigmas of what is expected.
    """

    def __init__(self, problem: RadarProblem, state: RadarState) -> None:
        step_s = _step_s(problem.frames, SCHEDULE.dt_compare_step_m)
        self.middle = int((2 * problem.dt_sigma_s + abs(state.dt_s)) / step_s) + SCHEDULE.dt_dip_steps
        steps = range(-self.middle, self.middle + 1)
        self.problem, self.states = problem, [replace(state, dt_s=state.dt_s + step_s * k) for k in steps]
        self.near = np.array([abs(other.dt_s) <= 2 * problem.dt_sigma_s for other in self.states])

    def depth(self) -> Float[np.ndarray, "K F"]:
        """Depth of each frame's dip, at equal sigmas for all states."""
        return dips(np.array([comparison_cost(self.problem, state) for state in self.states]))

    @cached_property
    def own_depth(self) -> Float[np.ndarray, "K F"]:
        """The same at the radar's own sigmas, from few detections, because it is used for confirmation only."""
        found = []
        for state in self.states:
            sigma = np.maximum(state.sigma, 0.5 * REGISTRATION_COMPARISON_SIGMA)  # dips as wide as steps
            about = (
                self.problem.frames,
                state.T_lidar_radar,
                state.dt_s,
                sigma,
                OUTLIER_DENSITY,
                _OWN_STRIDE,
            )
            found.append(registration_cost(*about, state.range_bias_m))
        return dips(np.array(found))


def better_time_offset(others: OtherOffsets) -> RadarState | None:
    """The state with another time offset, if the frames' cost dips clearly deeper there.

    Sharp sigmas reach half a metre: at 30 m/s an error of 20 ms is beyond that, and would stay. Dips are
    searched twice: at equal sigmas for all states, and, without a result, at the radar's own.
    """
    for by_own, clearly in ((False, _CLEARLY), (True, _CLEARLY_BY_OWN)):
        depth = others.own_depth if by_own else others.depth()
        depth = depth - depth[others.middle]
        best = int(np.argmin(np.where(others.near, depth.mean(1), np.inf)))
        error = depth[best].std() / np.sqrt(depth.shape[1])
        if abs(best - others.middle) > 1 and depth[best].mean() < -clearly * error:
            return others.states[best]
    return None


def time_offset_scatter_s(
    others: OtherOffsets, block: Int[np.ndarray, " F"], rng: np.random.Generator
) -> float:
    """Scatter [s] of the deepest dip about a solution's time offset, over resampled blocks of frames.

    Walls of a tunnel match themselves wherever the car is. Of many shallow dips, the deepest was up to 158 ms
    off on eleven drawn days, at sigmas of 3 to 11, the width of one dip. Blocks of frames disagree about which
    dip is the deepest.
    """
    near = others.near.copy()
    near[others.middle] = True  # the solution, however far it is from what is expected
    dt_s = np.array([state.dt_s for state in others.states])[near]
    _, index = np.unique(block, return_inverse=True)
    blocks = int(index.max()) + 1
    by_block = np.zeros((blocks, len(dt_s)))
    np.add.at(by_block, index, others.own_depth[near].T)
    drawn = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=_RESAMPLES)
    deepest = dt_s[np.argmin(drawn @ by_block, axis=1)]
    return float(np.sqrt(np.mean((deepest - others.states[others.middle].dt_s) ** 2)))


def far_time_offset(problem: RadarProblem, state: RadarState) -> dict[str, float]:
    """The time offset within a second at which the frames' cost dips deepest, at any distance.

    Returns `own_dt_s`, as in a record, and `own_dt_z`: by how many standard errors the dip is deeper than the
    solution's, 0 if it is the solution's.
    """
    some = problem.of_frames(np.arange(0, problem.frames.count, _FAR_STRIDE))
    step_s = _step_s(some.frames, SCHEDULE.dt_scan_step_m)
    offsets = np.append(state.dt_s, np.arange(-_FAR_S, _FAR_S + step_s, step_s))
    cost = np.array([comparison_cost(some, replace(state, dt_s=float(dt_s))) for dt_s in offsets])
    order = np.argsort(offsets, kind="stable")
    depth = np.empty_like(cost)
    depth[order] = dips(cost[order])
    best = int(np.argmin(depth.mean(1)))
    deeper = depth[best] - depth[0]
    error = max(float(deeper.std()), 1e-12) / np.sqrt(len(deeper))
    return {
        "own_dt_s": float(offsets[best]) - problem.constant_gap_s,
        "own_dt_z": float(deeper.mean() / error),
    }


def comparison_cost(problem: RadarProblem, state: RadarState) -> Float[np.ndarray, " F"]:
    """Cost of each frame, to compare the ends of different starts: the same sigmas for all."""
    T, dt_s = state.T_lidar_radar, state.dt_s
    return registration_cost(
        problem.frames, T, dt_s, REGISTRATION_COMPARISON_SIGMA, OUTLIER_DENSITY, stride=2
    )


def _step_s(frames: RegistrationFrames, step_m: float) -> float:
    """Step of time in which the car drives the given distance."""
    speed_mps = float(np.sqrt(np.mean(np.sum(frames.velocity_mps**2, axis=1))))
    return step_m / max(speed_mps, SCHEDULE.least_scan_speed_mps)


# --------------------------------------------------------------------------------------------------
# Search for lidar-radar: a scan about the vertical, annealed Newton steps, accelerated last steps.


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
    linear: Linear, state: RadarState, valley: _Valley, em_share: float, fixed: Bool[np.ndarray, " P"]
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
