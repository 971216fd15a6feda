"""Lidar-radar half of method `joint`: T_lidar_radar and the radar's time offset from a day of observations.

What the day cannot determine keeps the prior: after the first solution, every unknown of the pose whose variance the
day did not halve, and likewise the time offset, is held at the prior's value and sigma, the others are solved again,
and what the held ones leave open is part of their covariance. A weakly determined unknown would else wander along
whatever the scene offers, by many sigmas of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.normal_equations import (
    AZIMUTH_RANGE_DOF,
    DT,
    OUTLIER,
    RANGE,
    RANGE_BIAS_SIGMA_M,
    STEP_LIMIT,
    UNKNOWNS,
    Linear,
    RadarProblem,
    RadarState,
    beam_spacing,
    elevation_spread,
    linearise,
)
from pipeline.calibrate.joint.lidar_radar.radar_velocity import contradicts_odometry, turns_unmeasured
from pipeline.calibrate.joint.lidar_radar.search import FREE, anneal, finish, last_step, scan
from pipeline.calibrate.numerics.covariance import OBSERVABLE, covariance_with_fixed
from pipeline.calibrate.numerics.frame_blocks import bootstrap_blocks
from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.geometry.changes import change_between, change_jacobian
from pipeline.objective.radar.moving_clusters import moving_clusters
from pipeline.objective.radar.registration import normal_equations, registration_frames
from pipeline.objective.radar.vehicle_boxes import vehicle_boxes
from schemas.observations import Observation

__all__ = ["estimate_lidar_radar"]

_FEWEST_FRAMES = 5
_MANY_FRAMES = 60  # from here on half of them find the basin
_VERDICT_SIGMA = np.array(
    [np.radians(0.5), np.radians(6.0), 0.2]
)  # wide in elevation: that is not what decides
# What resampling can't show, sigma per DoF: a radar's own constant elevation error looks like pitch and is taken as
# 0 +- 0.2 deg (a thirtieth of a car radar's resolution cell), unobserved roll tilts azimuths, radars see into objects.
# Yaw, x and y: what the errors of 16 simulated days with known truth (40 frames; .021 deg, .029 m, .015 m) leave beyond
# resampling's .027 deg, .018 m and .010 m.
_ELEVATION_BIAS_RAD = np.radians(0.2)
_BIAS_FLOOR = np.array([np.radians(0.1), _ELEVATION_BIAS_RAD, np.radians(0.01), 0.025, 0.013, 0.02])
_DT_FLOOR_S = 0.002  # halves of a real day differed by 3 ms where resampling said 1
_DT_TOLD_S = 0.005  # a time offset known no better than this is called so
_CLEARLY = 4.0  # standard errors by which frames reject the end of another start
_CAMERA_SIGMA_RAD = np.radians(0.5)  # a camera less sure than what its boxes tell is left out
_CLOCK_STEP_M, _CLOCK_LEAST_MPS = 0.2, 8.0  # steps of time in metres of way; slower cars need no finer ones
_NAMES = np.array(["roll", "pitch", "yaw", "x", "y", "z"])
_DOF_UNITS = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


@dataclass(frozen=True, eq=False)
class _Settled:
    """The solution in which every unknown is either determined by the day or held at the prior."""

    state: RadarState
    linear: Linear
    covariance: np.ndarray  # of all unknowns, turns about the radar
    held: np.ndarray
    observability: np.ndarray  # of pose and dt


def estimate_lidar_radar(
    observations: Sequence[Observation],
    prior: Prior,
    T_camera_lidar: Float[np.ndarray, "4 4"] | None,
    config: SolveConfig,
    rng: np.random.Generator,
    *,
    covariance_camera_lidar: Float[np.ndarray, "6 6"] | None = None,
) -> PairEstimate:
    """Estimate T_lidar_radar and the radar's time offset (stamp_lidar = stamp_radar + dt).

    Args:
        observations: the day's frames.
        prior: start, and weak information; it loses weight where the data contradict it by many sigmas, and stands
            where they say little.
        T_camera_lidar: brings the camera's boxes in; None leaves roll and pitch to the registration and the prior.
        config: search range, sigma of the time offset, resampling.
        rng: picks detections and resamples.
        covariance_camera_lidar: of T_camera_lidar; None = exact.

    Raises:
        SolveError: too few frames with static detections and a lidar map.
    """
    given, observations = len(observations), _believed(observations)
    frames = registration_frames(observations, prior.T_lidar_radar, rng)
    found = frames.count
    turning = turns_unmeasured([observations[k] for k in frames.frame])
    frames = frames.subset(np.flatnonzero(~turning))
    rejected = {
        "radar velocity contradicts the odometry": given - len(observations),
        "no static detections or lidar map": len(observations) - found,
        "turns at an unknown yaw rate": found - frames.count,
    }
    if frames.count < _FEWEST_FRAMES:
        raise SolveError(
            f"lidar-radar needs {_FEWEST_FRAMES} frames with static detections, the day has {frames.count}"
        )
    if (
        covariance_camera_lidar is not None
        and np.diag(covariance_camera_lidar)[:3].max() > _CAMERA_SIGMA_RAD**2
    ):
        T_camera_lidar = None  # its own error would go into roll and pitch
    if "boxes" not in config.terms:
        T_camera_lidar = None
    problem = RadarProblem(
        observations,
        frames,
        moving_clusters(observations, with_boxes=False),
        vehicle_boxes(observations),
        T_camera_lidar,
        prior,
        config.time_offset_sigma_s,
        beam_spacing(observations),
        elevation_spread(frames),
        config.terms,
    )
    some = problem if frames.count < _MANY_FRAMES else problem.of_frames(np.arange(0, frames.count, 2))
    ends = [anneal(some, start) for start in scan(problem, config)]
    costs = [_sharp_cost(problem, end) for end in ends]
    best = ends[int(np.argmin([c.mean() for c in costs]))]
    settled = _settle(problem, best, covariance_camera_lidar, config, rng)
    clock = _better_clock(problem, settled.state)
    if clock is not None:
        settled = _settle(problem, clock, covariance_camera_lidar, config, rng)
    parts = [problem.of_frames(np.arange(k, frames.count, 2)) for k in (0, 1)]
    halves = [finish(part, settled.state, settled.held)[0] for part in parts]
    return _conclude(problem, settled, [best, _rival(ends, costs)], halves, rejected)


def _believed(observations: Sequence[Observation]) -> list[Observation]:
    """Frames whose radar knows what stands still."""
    wrong = contradicts_odometry(observations)
    return [o for o, w in zip(observations, wrong, strict=True) if not w]


def _sharp_cost(problem: RadarProblem, state: RadarState) -> np.ndarray:
    """Cost of each frame that compares ends of different starts: same sigmas for all."""
    T, dt_s = state.T_lidar_radar, state.dt_s
    return normal_equations(problem.frames, T, dt_s, _VERDICT_SIGMA, 0.0, OUTLIER, stride=2).cost


def _better_clock(problem: RadarProblem, state: RadarState) -> RadarState | None:
    """The state with another time offset, where the frames clearly rate that better than the solution's own.

    Sharp steps see half a metre: at 30 m/s an offset of 20 ms is out of their reach, and stays where it began.
    """
    speed_mps = float(np.sqrt(np.mean(np.sum(problem.frames.velocity_mps**2, axis=1))))
    step_s = _CLOCK_STEP_M / max(speed_mps, _CLOCK_LEAST_MPS)
    count = int(2 * problem.dt_sigma_s / step_s)
    own = _sharp_cost(problem, state)
    others = [replace(state, dt_s=step_s * k) for k in range(-count, count + 1)]
    costs = [_sharp_cost(problem, other) - own for other in others]
    best = int(np.argmin([c.mean() for c in costs]))
    better = costs[best].mean() < -_CLEARLY * costs[best].std() / np.sqrt(len(own))
    apart = abs(others[best].dt_s - state.dt_s) > step_s
    return others[best] if better and apart else None


def _rival(ends: list[RadarState], costs: list[np.ndarray]) -> RadarState:
    """The end of another start that the frames do not clearly rate below the best one; else the best one itself."""
    best = int(np.argmin([c.mean() for c in costs]))
    for end, cost in zip(ends, costs, strict=True):
        worse = cost - costs[best]
        if end is not ends[best] and worse.mean() < _CLEARLY * worse.std() / np.sqrt(len(worse)):
            return end
    return ends[best]


def _settle(
    problem: RadarProblem,
    state: RadarState,
    covariance_camera_lidar: np.ndarray | None,
    config: SolveConfig,
    rng: np.random.Generator,
) -> _Settled:
    """Solve, hold what the day did not determine, and solve again until nothing more has to be held."""
    block = bootstrap_blocks(np.array([o.drive for o in problem.observations]), config.bootstrap_blocks)
    before = np.append(np.diag(problem.prior.covariance("lidar_radar")), problem.dt_sigma_s**2)
    held, observability = FREE.copy(), np.ones(DT + 1)
    while True:
        if held.any() and not held[DT]:
            # Free, x had followed dt through their valley; back at the prior, dt may be out of reach.
            state = state.kept(problem.prior, held)
            state = _better_clock(problem, state) or state
        # Once the radar's sigmas are known, comparing solutions asks that they stay.
        state, linear = finish(problem, state, held, sharpen=not held.any())
        information = _with_measured_curvature(problem, state, linear.information)
        curvature = information.sum(0) + linear.pull
        variance = 1 / np.diag(linear.pull)
        variance[: DT + 1] = np.where(held[: DT + 1], before, variance[: DT + 1])
        full = covariance_with_fixed(information, linear.g, variance, curvature, held, block, rng)
        full[:2, :2] += _camera_share(problem, covariance_camera_lidar) * ~(held[:2, None] | held[:2])
        free = ~held[: DT + 1]
        bias = np.where(free, [*_BIAS_FLOOR**2, _DT_FLOOR_S**2 + _crawl(linear, state, held) ** 2], 0.0)
        told = _observability(np.diag(full)[: DT + 1], bias, before)
        observability[free] = told[free]
        if np.all(told[free] >= OBSERVABLE):
            break
        held[: DT + 1] |= told < OBSERVABLE
    full[np.arange(DT + 1), np.arange(DT + 1)] += bias
    return _Settled(state, linear, full, held, observability)


def _observability(variance: np.ndarray, bias: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Share of the prior's variance that the day would take away if its word were weighed with its own bias.

    Args:
        variance: of the estimate, day and prior together, without bias.
        bias: squared bias floor of what the day says.
        before: variance of the prior.
    """
    # A floor is an error of the day's word: it doesn't add to what the prior knows.
    day = 1 / np.maximum(1 / variance - 1 / before, 1e-9 / before) + bias
    return before / (before + day)


def _conclude(
    problem: RadarProblem,
    settled: _Settled,
    ends: list[RadarState],
    halves: list[RadarState],
    rejected: dict[str, int],
) -> PairEstimate:
    state, held = settled.state, settled.held
    notes = _notes(settled)
    # The record's covariance is of a left perturbation: a turn about the lidar carries the radar along.
    J = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    return PairEstimate(
        "lidar_radar",
        state.T_lidar_radar,
        J @ settled.covariance[:6, :6] @ J.T,
        settled.observability[:6],
        ~held[:6],
        problem.frames.count,
        {reason: count for reason, count in rejected.items() if count},
        state.dt_s,
        float(np.sqrt(settled.covariance[DT, DT])),
        _diagnostics(settled, ends, halves),
        notes,
    )


def _notes(settled: _Settled) -> list[str]:
    """What was not determined, and what was assumed."""
    held, linear = settled.held, settled.linear
    notes = []
    if held[:6].any():
        notes.append(f"not determined by this day, kept at the prior: {', '.join(_NAMES[held[:6]])}")
    dt_sigma_s = float(np.sqrt(settled.covariance[DT, DT]))
    if held[DT]:
        notes.append("time offset not determined by this day, kept at the prior")
    elif dt_sigma_s > _DT_TOLD_S:
        notes.append(
            f"time offset known to {1e3 * dt_sigma_s:.0f} ms only: where the car keeps one speed, x looks the same"
        )
    if linear.boxes < _FEWEST_FRAMES:
        notes.append(
            "no vehicle boxes with radar elevations: roll and pitch rest on the registration and the prior"
        )
    else:
        notes.append("radar pitch assumes that returns lie at a constant angle (0 +- 1 deg) from box centres")
    bias_sigma_m = float(np.sqrt(settled.covariance[RANGE, RANGE]))
    pitch_deg = float(np.degrees(_ELEVATION_BIAS_RAD))
    notes += [
        f"assumes a constant elevation error of the radar of 0 +- {pitch_deg:.2f} deg: it looks like pitch",
        f"range bias {settled.state.range_bias_m:+.3f} +- {bias_sigma_m:.3f} m (prior 0 +- {RANGE_BIAS_SIGMA_M:.2f})",
    ]
    return notes


def _diagnostics(settled: _Settled, ends: list[RadarState], halves: list[RadarState]) -> dict[str, float]:
    state, linear = settled.state, settled.linear
    half = change_between(halves[1].T_lidar_radar, halves[0].T_lidar_radar)
    apart = change_between(ends[-1].T_lidar_radar, ends[0].T_lidar_radar)
    diagnostics = {
        "azimuth_sigma_rad": float(state.sigma[0]),
        "elevation_sigma_rad": float(state.sigma[1]),
        "range_sigma_m": float(state.sigma[2]),
        "range_bias_m": state.range_bias_m,
        "range_bias_sigma_m": float(np.sqrt(settled.covariance[RANGE, RANGE])),
        "bounce_share": state.bounce,
        "assigned_share": float(linear.registration.assigned.mean()),
        "boxes": float(linear.boxes),
        "box_sigma_rad": linear.box_sigma_rad,
        **{f"box_bias_{k}_rad": float(v) for k, v in zip(("car", "large"), state.bias_rad, strict=True)},
        "moving_azimuth_sigma_rad": linear.mover_sigma_rad,
        "registration_roll_offset_rad": float(linear.registration_step[0]),
        "registration_pitch_offset_rad": float(linear.registration_step[1]),
        "registration_roll_sigma_rad": float(linear.floor[0]),
        "registration_pitch_sigma_rad": float(linear.floor[1]),
        **{f"halves_{n}": float(v) for n, v in zip(_DOF_UNITS, half, strict=True)},
        "halves_dt_s": halves[0].dt_s - halves[1].dt_s,
        "restarts_rz_rad": float(apart[2]),
        "restarts_tx_m": float(apart[3]),
        "restarts_ty_m": float(apart[4]),
    }  # fmt: skip
    return {k: v for k, v in diagnostics.items() if np.isfinite(v)}


def _with_measured_curvature(problem: RadarProblem, state: RadarState, information: np.ndarray) -> np.ndarray:
    """Curvature over yaw, x, y, dt and range bias as the cost itself has it, from differences of its gradient.

    On days of one speed, x, dt and the range bias share a valley that is far flatter than soft assignment promises.
    """
    dof = AZIMUTH_RANGE_DOF
    total = information.sum(0)[np.ix_(dof, dof)]
    measured = np.zeros_like(total)
    for column, k in enumerate(dof):
        step = np.zeros(UNKNOWNS)
        step[k] = 0.05 * STEP_LIMIT[k]
        ahead, behind = (_gradient(problem, state.moved(s)) for s in (step, -step))
        measured[:, column] = (ahead - behind) / (2 * step[k])
    # A standing car says nothing of dt: what is added is far below any prior.
    L = np.linalg.cholesky(total + np.diag(1e-3 / STEP_LIMIT[dof] ** 2))
    W = np.linalg.solve(L, np.linalg.solve(L, 0.5 * (measured + measured.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = L @ vectors
    out = information.copy()
    out[np.ix_(np.arange(len(out)), dof, dof)] += (
        (root * np.clip(values, 0.02, 1.0)) @ root.T - total
    ) / len(out)
    return out


def _gradient(problem: RadarProblem, state: RadarState) -> np.ndarray:
    g = linearise(problem, state, 1.0, None).g
    return g.sum(0)[AZIMUTH_RANGE_DOF]


def _crawl(linear: Linear, state: RadarState, held: np.ndarray) -> float:
    """Ten of the steps of dt that were still to come [s], for the valley is flat."""
    return float(10 * last_step(linear, state, held)[DT])


def _camera_share(problem: RadarProblem, covariance: np.ndarray | None) -> np.ndarray:
    """Roll and pitch inherit the camera-lidar rotation's own errors through the boxes."""
    if covariance is None or problem.T_camera_lidar is None:
        return np.zeros((2, 2))
    R = problem.T_camera_lidar[:3, :3]
    return (R.T @ covariance[:3, :3] @ R)[:2, :2]
