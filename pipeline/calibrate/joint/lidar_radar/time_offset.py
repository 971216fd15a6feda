"""The radar's time offset among many: the one at which the registration's cost dips, not its lowest value.

Along the direction of travel the cost has a slope that is unrelated to time: a cloud has more points near the
car, so detections moved towards the car match more of them. On a simulated highway (30 m/s, 16 rings) the
cost fell by half from 0 to -130 ms, and only a dip of three steps marked the true 20 ms. The criterion is
therefore the cost below that of its surroundings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from pipeline.calibrate.joint.lidar_radar.problem import RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.schedule import SCHEDULE
from pipeline.calibrate.numerics.bias_floors import OUTLIER_DENSITY, REGISTRATION_COMPARISON_SIGMA
from pipeline.objective.radar.registration import SIGMA_START, RegistrationFrames, registration_cost

__all__ = [
    "better_time_offset",
    "comparison_cost",
    "dips",
    "far_time_offset",
    "scan_time_offset",
    "time_offset_scatter_s",
]

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


def better_time_offset(problem: RadarProblem, state: RadarState) -> RadarState | None:
    """The state with another time offset, if the frames' cost dips clearly deeper there.

    Sharp sigmas reach half a metre: at 30 m/s an error of 20 ms is beyond that, and would stay. Dips are
    searched twice: at equal sigmas for all states, and, without a result, at the radar's own.
    """
    others, near = _others(problem, state)
    count = len(others) // 2
    for cost, clearly in ((comparison_cost, _CLEARLY), (_own_cost, _CLEARLY_BY_OWN)):
        depth = dips(np.array([cost(problem, other) for other in others]))
        depth -= depth[count]  # the solution's own
        best = int(np.argmin(np.where(near, depth.mean(1), np.inf)))
        if abs(best - count) > 1 and depth[best].mean() < -clearly * depth[best].std() / np.sqrt(
            depth.shape[1]
        ):
            return others[best]
    return None


def time_offset_scatter_s(
    problem: RadarProblem, state: RadarState, block: Int[np.ndarray, " F"], rng: np.random.Generator
) -> float:
    """Scatter [s] of the deepest dip about a solution's time offset, over resampled blocks of frames.

    Walls of a tunnel match themselves wherever the car is. Of many shallow dips, the deepest was up to 158 ms
    off on eleven drawn days, at sigmas of 3 to 11, the width of one dip. Blocks of frames disagree about which
    dip is the deepest.
    """
    others, near = _others(problem, state)
    near[len(others) // 2] = True  # the solution, however far it is from what is expected
    depth = dips(np.array([_own_cost(problem, other) for other in others]))[near]
    dt_s = np.array([other.dt_s for other, is_near in zip(others, near, strict=True) if is_near])
    _, index = np.unique(block, return_inverse=True)
    blocks = int(index.max()) + 1
    by_block = np.zeros((blocks, len(dt_s)))
    np.add.at(by_block, index, depth.T)
    drawn = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=_RESAMPLES)
    deepest = dt_s[np.argmin(drawn @ by_block, axis=1)]
    return float(np.sqrt(np.mean((deepest - state.dt_s) ** 2)))


def _others(problem: RadarProblem, state: RadarState) -> tuple[list[RadarState], Bool[np.ndarray, " K"]]:
    """A solution at other time offsets, itself in the middle, and which are within two sigmas of what is expected."""
    step_s = _step_s(problem.frames, SCHEDULE.dt_compare_step_m)
    count = int((2 * problem.dt_sigma_s + abs(state.dt_s)) / step_s) + SCHEDULE.dt_dip_steps
    others = [replace(state, dt_s=state.dt_s + step_s * k) for k in range(-count, count + 1)]
    return others, np.array([abs(other.dt_s) <= 2 * problem.dt_sigma_s for other in others])


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


def _own_cost(problem: RadarProblem, state: RadarState) -> Float[np.ndarray, " F"]:
    """Cost of each frame at the radar's own sigmas, from few detections, because it is used for confirmation only."""
    sigma = np.maximum(state.sigma, 0.5 * REGISTRATION_COMPARISON_SIGMA)  # dips as wide as steps
    T, dt_s = state.T_lidar_radar, state.dt_s
    return registration_cost(problem.frames, T, dt_s, sigma, OUTLIER_DENSITY, _OWN_STRIDE, state.range_bias_m)


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
