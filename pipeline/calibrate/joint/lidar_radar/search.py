"""Search for lidar-radar: a scan about the vertical, annealed Newton steps, accelerated last steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.lidar_radar.normal_equations import (
    DT,
    OUTLIER,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
    linearise,
)
from pipeline.config import SolveConfig
from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.objective.radar.registration import BOUNCE_PRIOR, SIGMA_START, normal_equations, updated_sigma
from pipeline.objective.radar.vehicle_boxes import BOX_CLASSES, BoxPairs, box_pairs

__all__ = ["FREE", "anneal", "finish", "last_step", "scan"]

FREE = np.zeros(UNKNOWNS, bool)  # no unknown held
_WIDEST = 4.0  # anneal from this many sigmas
_COOLING = 0.75
_STEPS = 14
_DT_SCANS = {4: 1.5, 8: 0.8, 11: 0.5}  # after so many steps, with so many times the starting sigmas
_FINAL_STEPS = 20
_STILL = 0.003  # of the step limit: 0.1 ms, 0.5 mm, 0.01 deg
_CAUTION = 0.15  # share of EM in the last steps
_NO_DT = np.arange(UNKNOWNS) == DT
_DT_STEP_S, _LEAST_DT_S = 0.01, 2e-5  # longest step, and shortest from which a slope is believed
_DT_SCAN_M, _DT_SCAN_MPS = 0.25, 8.0  # step in metres; slower cars need no finer steps of time
_FLATNESS = (0.03, 1.5)
_SCAN_STEP_RAD = np.radians(1.5)
_SCAN_FRAMES = 24  # are enough to tell basins apart
_BOX_GATE_RAD = (np.radians(12.0), np.radians(7.0))  # at the start, and once pitch and roll are about right


def scan(problem: RadarProblem, config: SolveConfig) -> list[RadarState]:
    """The prior, and the best turn about the vertical that is not next to it, by the wide cost of a few frames."""
    reach = np.radians(max(config.search_rotation_deg, 6.0)) * 1.7
    turns = np.arange(-np.ceil(reach / _SCAN_STEP_RAD), np.ceil(reach / _SCAN_STEP_RAD) + 1) * _SCAN_STEP_RAD
    few = np.unique(np.linspace(0, problem.frames.count - 1, _SCAN_FRAMES).astype(int))
    part = problem.frames.subset(few)
    sigma = SIGMA_START * np.array([2.0, 3.0, 2.0])
    T0 = problem.prior.T_lidar_radar
    poses = [
        from_rotation_translation(exp_so3(np.array([0.0, 0.0, a])) @ T0[:3, :3], T0[:3, 3]) for a in turns
    ]
    cost = [float(normal_equations(part, T, 0.0, sigma, 0.0, OUTLIER, stride=3).cost.mean()) for T in poses]
    bias = np.zeros(len(BOX_CLASSES))
    best = int(np.argmin(cost if "static" in problem.terms else np.abs(turns)))
    chosen = [best] if abs(turns[best]) < 0.5 * _SCAN_STEP_RAD else [best, int(np.argmin(np.abs(turns)))]
    return [RadarState(poses[k], 0.0, 0.0, bias, SIGMA_START.copy(), BOUNCE_PRIOR) for k in chosen]


def anneal(problem: RadarProblem, state: RadarState) -> RadarState:
    """Newton steps with re-association at every step, from wide sigmas to the radar's own.

    `problem` may be a part of the day: this finds the basin, `finish` its floor.
    """
    pairs, valley = None, _Valley()
    for k in range(_STEPS):
        widen = max(1.0, _WIDEST * _COOLING**k)
        if k in (0, _STEPS // 2):
            pairs = _boxes(problem, state, _BOX_GATE_RAD[min(k, 1)])
        linear = linearise(problem, state, widen, pairs, stride=3)
        if k in _DT_SCANS:
            state, valley = _scan_dt(problem, state, _DT_SCANS[k]), _Valley()
        # Where sigmas are wide, dt would only wander: what it shifts, x can shift as well.
        held = _NO_DT if widen > 1.0 else FREE
        step, valley = _next_step(linear, state, valley, 1.0 if widen > 1.0 else 0.5, held)
        state = state.moved(step)
        if widen == 1.0:
            state, valley = _sharpened(linear, state), valley.forgetting()
    return state


def _scan_dt(problem: RadarProblem, state: RadarState, widen: float) -> RadarState:
    """The time offset under which most detections meet the lidar, by the medium cost of some frames.

    At 30 m/s 25 ms are 0.75 m: posts and signs are then out of reach of sharp sigmas, and guard rails meet themselves.
    """
    frames = problem.frames
    speed = float(np.sqrt(np.mean(np.sum(frames.velocity_mps**2, axis=1))))
    step_s = _DT_SCAN_M / max(speed, _DT_SCAN_MPS)
    count = int(np.ceil(2 * problem.dt_sigma_s / step_s))
    part = frames.subset(np.arange(0, frames.count, 1 + (frames.count > _SCAN_FRAMES)))
    offsets = state.dt_s + step_s * np.arange(-count, count + 1)

    def cost(dt_s: float) -> float:
        T, sigma = state.T_lidar_radar, widen * SIGMA_START
        fit = normal_equations(part, T, dt_s, sigma, 0.0, OUTLIER, 3, state.range_bias_m).cost.sum()
        detections = max(len(part.radar_m) / 3 / max(part.count, 1), 1.0)
        return float(fit * detections) + 0.5 * (dt_s / problem.dt_sigma_s) ** 2

    return replace(state, dt_s=float(offsets[int(np.argmin([cost(float(dt_s)) for dt_s in offsets]))]))


def finish(
    problem: RadarProblem, state: RadarState, held: Bool[np.ndarray, " P"] = FREE, sharpen: bool = False
) -> tuple[RadarState, Linear]:
    """All detections: steps until nothing moves, and the equations there.

    Args:
        problem: the day.
        state: start.
        held: unknowns of the pose and dt that keep the prior's value.
        sharpen: let the radar's sigmas follow the residuals; else they stay.
    """
    state = state.kept(problem.prior, held)
    pairs = _boxes(problem, state, _BOX_GATE_RAD[1])
    valley = _Valley()
    for k in range(_FINAL_STEPS):
        linear = linearise(problem, state, 1.0, pairs)
        step, valley = _next_step(linear, state, valley, _CAUTION, held)
        state = state.moved(step).kept(problem.prior, held)
        still = np.max(np.abs(step) / STEP_LIMIT) < _STILL
        if sharpen and k < _FINAL_STEPS // 2 and (still or k % 3 == 2):
            before = state.sigma
            state, valley = _sharpened(linear, state), valley.forgetting()
            still = still and np.max(np.abs(state.sigma / before - 1)) < 0.02
        if still:
            break
    return state, linearise(problem, state, 1.0, pairs)


def _sharpened(linear: Linear, state: RadarState) -> RadarState:
    sigma, bounce = updated_sigma(linear.registration, state.sigma, state.bounce)
    return replace(state, sigma=sigma, bounce=bounce)


@dataclass(frozen=True)
class _Valley:
    """What past steps showed of the cost along dt, all other unknowns following."""

    dt_s: float | None = None
    gradient: float = 0.0
    flatness: float = 1.0  # curvature seen, as a share of what soft assignment promises

    def forgetting(self) -> _Valley:
        """Only the shape: the gradient belonged to other sigmas."""
        return replace(self, dt_s=None)

    def seen(self, dt_s: float, gradient: float, promised: float) -> _Valley:
        """With one more point."""
        flatness = self.flatness
        if self.dt_s is not None and abs(dt_s - self.dt_s) > _LEAST_DT_S:
            flatness = float(np.clip((gradient - self.gradient) / (dt_s - self.dt_s) / promised, *_FLATNESS))
        return _Valley(dt_s, gradient, flatness)


def _next_step(
    linear: Linear,
    state: RadarState,
    valley: _Valley,
    caution: float,
    held: Bool[np.ndarray, " P"],
) -> tuple[Float[np.ndarray, " P"], _Valley]:
    """EM step (caution 1), or nearly Newton's with the information that assignment leaves (caution near 0).

    On days of one speed dt, x and the range bias share a valley that is far flatter than any of these promises: along
    dt, with the others following, the step is the secant's.
    """
    H = caution * linear.H.sum(0) + (1 - caution) * linear.information.sum(0) + linear.pull
    g = linear.g.sum(0) + linear.pull_g
    step, others = np.zeros(UNKNOWNS), ~held
    others[DT] = False
    solved = np.linalg.solve(H[np.ix_(others, others)], np.stack([g[others], H[others, DT]], 1))
    if not held[DT]:
        promised = float(H[DT, DT] - H[DT, others] @ solved[:, 1])
        gradient = float(g[DT] - H[DT, others] @ solved[:, 0])
        valley = valley.seen(state.dt_s, gradient, promised)
        move = -gradient / (promised * valley.flatness)
        step[DT] = np.clip(move, -_DT_STEP_S, _DT_STEP_S)
    step[others] = -(1 + 0.5 * caution) * solved[:, 0] - solved[:, 1] * step[DT]
    return step / max(1.0, float(np.max(np.abs(step) / STEP_LIMIT))), valley


def last_step(linear: Linear, state: RadarState, held: Bool[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """The step that soft assignment would still take."""
    return _next_step(linear, state, _Valley(), _CAUTION, held)[0]


def _boxes(problem: RadarProblem, state: RadarState, gate: float) -> BoxPairs | None:
    if problem.T_camera_lidar is None:
        return None
    return box_pairs(problem.observations, problem.boxes, problem.T_camera_lidar @ state.T_lidar_radar, gate)
