"""Search for lidar-radar: a scan about the vertical, annealed Newton steps, accelerated last steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.config import SolveConfig
from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.objective.boxes import BOX_CLASSES, BoxPairs, box_pairs
from pipeline.objective.registration import BOUNCE_PRIOR, SIGMA_START, normal_equations, updated_sigma
from pipeline.solve.lidar_radar_equations import (
    DT,
    OUTLIER,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
    linearise,
)

__all__ = ["FREE", "anneal", "finish", "last_step", "scan"]

FREE = np.zeros(UNKNOWNS, bool)  # no unknown held
_WIDEST = 4.0  # anneal from this many sigmas
_COOLING = 0.75
_STEPS = 16
_FINAL_STEPS = 20
_STILL = 0.003  # of the step limit: 0.1 ms, 0.5 mm, 0.01 deg
_MEMORY = 4
_MOST_GAIN = 4.0  # of an accelerated step
_CAUTION = (
    0.15  # share of EM in the last steps: EM alone leaves 5 ms of dt after 20 steps, none of it oscillates
)
_SCAN_STEP_RAD = np.radians(1.5)
_SCAN_FRAMES = 24
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
    """Newton steps with re-association at every step, from wide sigmas to the radar's own."""
    pairs = None
    for k in range(_STEPS):
        widen = max(1.0, _WIDEST * _COOLING**k)
        if k % 4 == 0:
            pairs = _boxes(problem, state, _BOX_GATE_RAD[0 if k < _STEPS // 2 else 1])
        linear = linearise(problem, state, widen, pairs, stride=3)
        state = state.moved(_next_step(linear))
        if widen == 1.0:
            sigma, bounce = updated_sigma(linear.registration, state.sigma, state.bounce)
            state = replace(state, sigma=sigma, bounce=bounce)
    return state


def finish(
    problem: RadarProblem, state: RadarState, held: Bool[np.ndarray, " P"] = FREE
) -> tuple[RadarState, Linear]:
    """All detections, sigmas held: steps until nothing moves, and the equations there.

    Args:
        problem: the day.
        state: start.
        held: unknowns of the pose and dt that keep the prior's value.
    """
    state = state.kept(problem.prior, held)
    pairs = _boxes(problem, state, _BOX_GATE_RAD[1])
    past: list[tuple[np.ndarray, np.ndarray]] = []  # where the state was, counted from here, and its step
    x = np.zeros(UNKNOWNS)
    for _ in range(_FINAL_STEPS):
        step = _next_step(linearise(problem, state, 1.0, pairs), _CAUTION, held)
        past = [*past[-_MEMORY:], (x, step)]
        move = _accelerated(past)
        x, state = x + move, state.moved(move).kept(problem.prior, held)
        if np.max(np.abs(move) / STEP_LIMIT) < _STILL:
            break
    return state, linearise(problem, state, 1.0, pairs)


def _accelerated(past: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The next move by Anderson's rule: dt, x and the range bias share a valley along which plain steps crawl.

    Source: Walker & Ni 2011, "Anderson acceleration for fixed-point iterations", in units of `STEP_LIMIT`.
    """
    step = past[-1][1]
    if len(past) < 3:
        return step
    X = np.diff([x for x, _ in past], axis=0) / STEP_LIMIT
    F = np.diff([f for _, f in past], axis=0) / STEP_LIMIT
    # A little damping keeps directions that only noise tells apart from blowing up.
    A = F @ F.T
    share = np.linalg.solve(A + 1e-3 * np.trace(A) / len(A) * np.eye(len(A)), F @ (step / STEP_LIMIT))
    move = step - share @ (X + F) * STEP_LIMIT
    # Re-association is noisy: go along the valley only where the gradient points.
    if move[DT] * step[DT] < 0:
        move = 2 * step
    gain = float(np.linalg.norm(move / STEP_LIMIT)) / max(float(np.linalg.norm(step / STEP_LIMIT)), 1e-12)
    move = step + (move - step) * min(1.0, _MOST_GAIN / gain)
    return move / max(1.0, float(np.max(np.abs(move) / (0.3 * STEP_LIMIT))))


def _next_step(
    linear: Linear, caution: float = 1.0, held: Bool[np.ndarray, " P"] = FREE
) -> Float[np.ndarray, " P"]:
    """EM step (caution 1), or nearly Newton's with the information that assignment leaves (caution near 0)."""
    H = caution * linear.H.sum(0) + (1 - caution) * linear.information.sum(0) + linear.pull
    free = ~held
    step = np.zeros(UNKNOWNS)
    step[free] = -(1 + 0.5 * caution) * np.linalg.solve(
        H[np.ix_(free, free)], (linear.g.sum(0) + linear.pull_g)[free]
    )
    return step / max(1.0, float(np.max(np.abs(step) / STEP_LIMIT)))


def last_step(linear: Linear, held: Bool[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """The step that `finish` would still take."""
    return _next_step(linear, _CAUTION, held)


def _boxes(problem: RadarProblem, state: RadarState, gate: float) -> BoxPairs | None:
    if problem.T_camera_lidar is None:
        return None
    return box_pairs(problem.observations, problem.boxes, problem.T_camera_lidar @ state.T_lidar_radar, gate)
