"""Lidar-radar half of method `joint`: T_lidar_radar and the radar's time offset from a day of observations.

Which term decides which degree of freedom is fixed here, for measured reasons: azimuth and range of the static
registration decide yaw, x, y and dt; its elevations say something of roll, pitch and z, but no more than the lidar's
own beam spacing allows (points collapse onto the rings, repeatably and with the lowest residual); the camera's vehicle
boxes decide roll, and pitch up to their constant. Moving clusters add azimuth. The prior keeps what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.geometry.se3 import exp_se3, exp_so3, from_rotation_translation, log_se3
from pipeline.objective.boxes import (
    BIAS_SIGMA_RAD,
    BOX_CLASSES,
    BoxPairs,
    VehicleBoxes,
    box_equations,
    box_pairs,
    vehicle_boxes,
)
from pipeline.objective.moving import MovingClusters, azimuth_equations_lidar, moving_clusters
from pipeline.objective.problem import PairEstimate, Prior
from pipeline.objective.registration import (
    BOUNCE_PRIOR,
    SIGMA_START,
    NormalEquations,
    RegistrationFrames,
    normal_equations,
    registration_frames,
    updated_sigma,
)
from pipeline.solve.covariance import blocks_of, bootstrap_covariance, posterior
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, Observation

__all__ = ["RadarState", "estimate_lidar_radar", "lidar_radar_cost"]

_FEWEST_FRAMES = 5
_OUTLIER = 0.2  # in lidar points at distance 0: assigns about 40 % of a real radar's static detections
_VERDICT_SIGMA = np.array(
    [np.radians(0.5), np.radians(6.0), 0.2]
)  # wide in elevation: that is not what decides
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
# What resampling can't show, sigma per DoF: unobserved roll tilts azimuths, radars see into objects, box constants.
# Roll: which detections of a box are taken moved it by 0.5 deg on real logs.
_BIAS_FLOOR = np.array([np.radians(0.5), np.radians(0.3), np.radians(0.10), 0.02, 0.02, 0.05])
_DT_FLOOR_S = 0.002  # halves of a real day differed by 3 ms where resampling said 1
# How far a lidar's rings mislead the registration's elevations, in beam spacings: real logs (2 deg) showed 4-5 deg
# of roll and 1-2 deg of pitch; simulation with 0.4 deg showed 0.3 deg. z by the same angle at 10 m, at least 0.25 m:
# elevation errors that change with range (bounces, the horizon) look like z, in simulation up to 0.4 m.
_ROLL_SPACINGS, _PITCH_SPACINGS, _Z_DISTANCE_M = 2.5, 0.8, 10.0
_Z_FLOOR_M = 0.25
_DEFAULT_SPACING_RAD = np.radians(1.0)
_CAMERA_SIGMA_RAD = np.radians(0.5)  # a camera less sure than what its boxes tell is left out
_AZIMUTH_RANGE_DOF = np.array([2, 3, 4, 6, 7])
_ELEVATION_DOF = np.array([0, 1, 5])
_DOF_UNITS = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")
_POSE, _DT, _RANGE = 6, 6, 7
_P = 8 + len(BOX_CLASSES)
_STEP_LIMIT = np.array([0.05] * 3 + [0.15] * 3 + [0.03, 0.1] + [0.05] * len(BOX_CLASSES))
_RANGE_BIAS_SIGMA_M = 0.05  # radars' own, and what lies behind the surface that the lidar sees


@dataclass(frozen=True, eq=False)
class RadarState:
    """Where the solver stands: pose, time offset, box biases, and the radar's sigmas."""

    T_lidar_radar: np.ndarray
    dt_s: float
    range_bias_m: float
    bias_rad: np.ndarray
    sigma: np.ndarray
    bounce: float

    def moved(self, step: Float[np.ndarray, " P"]) -> RadarState:
        """The state after a step."""
        return replace(
            self,
            T_lidar_radar=exp_se3(step[:_POSE]) @ self.T_lidar_radar,
            dt_s=self.dt_s + float(step[_DT]),
            range_bias_m=self.range_bias_m + float(step[_RANGE]),
            bias_rad=self.bias_rad + step[_RANGE + 1 :],
        )


@dataclass(frozen=True, eq=False)
class _Problem:
    """All that stays the same while the state moves."""

    observations: Sequence[Observation]
    frames: RegistrationFrames
    movers: MovingClusters
    boxes: VehicleBoxes
    T_camera_lidar: np.ndarray | None
    prior: Prior
    dt_sigma_s: float
    floor: np.ndarray  # sigma of roll, pitch, z as the registration's elevations give them

    def of_frames(self, index: np.ndarray) -> _Problem:
        """The same with part of the registration's frames (and of the observations behind them)."""
        chosen = self.frames.frame[index]
        part = [self.observations[i] for i in chosen]
        frames = replace(self.frames.subset(index), frame=np.arange(len(index), dtype=np.int64))
        return replace(
            self, observations=part, frames=frames, movers=moving_clusters(part), boxes=vehicle_boxes(part)
        )


@dataclass(frozen=True, eq=False)
class _Linear:
    """Normal equations per observation at one state, and what came with them."""

    H: np.ndarray  # F P P, for steps
    information: np.ndarray  # F P P, what the frames really say
    g: np.ndarray  # F P
    pull: np.ndarray
    pull_g: np.ndarray
    registration: NormalEquations
    box_sigma_rad: float
    boxes: int
    mover_sigma_rad: float
    registration_step: np.ndarray  # where elevations of the registration alone would put roll, pitch, z


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
        prior: start, and weak information; it loses weight where the data contradict it by many sigmas.
        T_camera_lidar: brings the camera's boxes in; None leaves roll and pitch to the registration and the prior.
        config: search range, sigma of the time offset, resampling.
        rng: picks detections and resamples.
        covariance_camera_lidar: of T_camera_lidar; None = exact.

    Raises:
        SolveError: too few frames with static detections and a lidar map.
    """
    frames = registration_frames(observations, prior.T_lidar_radar, rng)
    if frames.count < _FEWEST_FRAMES:
        raise SolveError(
            f"lidar-radar needs {_FEWEST_FRAMES} frames with static detections, the day has {frames.count}"
        )
    if (
        covariance_camera_lidar is not None
        and np.diag(covariance_camera_lidar)[:3].max() > _CAMERA_SIGMA_RAD**2
    ):
        T_camera_lidar = None  # its own error would go into roll and pitch
    problem = _Problem(
        observations,
        frames,
        moving_clusters(observations),
        vehicle_boxes(observations),
        T_camera_lidar,
        prior,
        config.time_offset_sigma_s,
        _elevation_floor(observations),
    )
    starts = _scan(problem, config)
    ends = [_anneal(problem, start) for start in starts]
    costs = [_sharp_cost(problem, end) for end in ends]
    state = ends[int(np.argmin(costs))]
    state, linear = _finish(problem, state)
    halves = [_finish(problem.of_frames(np.arange(k, frames.count, 2)), state)[0] for k in (0, 1)]
    return _conclude(problem, state, linear, ends, halves, covariance_camera_lidar, config, rng)


def lidar_radar_cost(
    observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float = 0.0
) -> Float[np.ndarray, " F"]:
    """Cost of each frame at a pose for held-out verdicts: minus mean log likelihood of static detections.

    Fixed sigmas, nothing fitted, wide in elevation. NaN where a frame has no static detections or no lidar map. The
    detections are picked alike at every pose.
    """
    out = np.full(len(observations), np.nan)
    frames = registration_frames(observations, T_lidar_radar, np.random.default_rng(0))
    if frames.count:
        out[frames.frame] = normal_equations(frames, T_lidar_radar, dt_s, _VERDICT_SIGMA, 0.0, _OUTLIER).cost
    return out


# -- search ----------------------------------------------------------------------------------------------------------


def _scan(problem: _Problem, config: SolveConfig) -> list[RadarState]:
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
    cost = [float(normal_equations(part, T, 0.0, sigma, 0.0, _OUTLIER, stride=3).cost.mean()) for T in poses]
    bias = np.zeros(len(BOX_CLASSES))
    best = int(np.argmin(cost))
    chosen = [best] if abs(turns[best]) < 0.5 * _SCAN_STEP_RAD else [best, int(np.argmin(np.abs(turns)))]
    return [RadarState(poses[k], 0.0, 0.0, bias, SIGMA_START.copy(), BOUNCE_PRIOR) for k in chosen]


def _anneal(problem: _Problem, state: RadarState) -> RadarState:
    """Newton steps with re-association at every step, from wide sigmas to the radar's own."""
    pairs = None
    for k in range(_STEPS):
        widen = max(1.0, _WIDEST * _COOLING**k)
        if k % 4 == 0:
            pairs = _boxes(problem, state, _BOX_GATE_RAD[0 if k < _STEPS // 2 else 1])
        linear = _linearise(problem, state, widen, pairs, stride=3)
        state = state.moved(_step(linear))
        if widen == 1.0:
            sigma, bounce = updated_sigma(linear.registration, state.sigma, state.bounce)
            state = replace(state, sigma=sigma, bounce=bounce)
    return state


def _finish(problem: _Problem, state: RadarState) -> tuple[RadarState, _Linear]:
    """All detections, sigmas held: steps until nothing moves, and the equations there."""
    pairs = _boxes(problem, state, _BOX_GATE_RAD[1])
    past: list[tuple[np.ndarray, np.ndarray]] = []  # where the state was, counted from here, and its step
    x = np.zeros(_P)
    for _ in range(_FINAL_STEPS):
        step = _step(_linearise(problem, state, 1.0, pairs), _CAUTION)
        past = [*past[-_MEMORY:], (x, step)]
        move = _accelerated(past)
        x, state = x + move, state.moved(move)
        if np.max(np.abs(move) / _STEP_LIMIT) < _STILL:
            break
    return state, _linearise(problem, state, 1.0, pairs)


def _accelerated(past: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The next move by Anderson's rule: dt, x and the range bias share a valley along which plain steps crawl.

    Source: Walker & Ni 2011, "Anderson acceleration for fixed-point iterations", in units of `_STEP_LIMIT`.
    """
    step = past[-1][1]
    if len(past) < 3:
        return step
    X = np.diff([x for x, _ in past], axis=0) / _STEP_LIMIT
    F = np.diff([f for _, f in past], axis=0) / _STEP_LIMIT
    # A little damping keeps directions that only noise tells apart from blowing up.
    A = F @ F.T
    share = np.linalg.solve(A + 1e-3 * np.trace(A) / len(A) * np.eye(len(A)), F @ (step / _STEP_LIMIT))
    move = step - share @ (X + F) * _STEP_LIMIT
    if (
        move[_DT] * step[_DT] <= 0
    ):  # re-association is noisy: go along the valley only where the gradient points
        move = 2 * step
    gain = float(np.linalg.norm(move / _STEP_LIMIT)) / max(float(np.linalg.norm(step / _STEP_LIMIT)), 1e-12)
    move = step + (move - step) * min(1.0, _MOST_GAIN / gain)
    return move / max(1.0, float(np.max(np.abs(move) / (0.3 * _STEP_LIMIT))))


def _step(linear: _Linear, caution: float = 1.0) -> np.ndarray:
    """EM step (caution 1), or nearly Newton's with the information that assignment leaves (caution near 0)."""
    H = caution * linear.H.sum(0) + (1 - caution) * linear.information.sum(0) + linear.pull
    step = -(1 + 0.5 * caution) * np.linalg.solve(H, linear.g.sum(0) + linear.pull_g)
    return step / max(1.0, float(np.max(np.abs(step) / _STEP_LIMIT)))


def _sharp_cost(problem: _Problem, state: RadarState) -> float:
    """Cost that compares ends of different starts: same sigmas for all."""
    equations = normal_equations(
        problem.frames, state.T_lidar_radar, state.dt_s, _VERDICT_SIGMA, 0.0, _OUTLIER, stride=2
    )
    return float(equations.cost.mean())


def _boxes(problem: _Problem, state: RadarState, gate: float) -> BoxPairs | None:
    if problem.T_camera_lidar is None:
        return None
    return box_pairs(problem.observations, problem.boxes, problem.T_camera_lidar @ state.T_lidar_radar, gate)


# -- equations -------------------------------------------------------------------------------------------------------


def _linearise(
    problem: _Problem, state: RadarState, widen: float, pairs: BoxPairs | None, stride: int = 1
) -> _Linear:
    F = len(problem.observations)
    H, info, g = np.zeros((F, _P, _P)), np.zeros((F, _P, _P)), np.zeros((F, _P))
    equations = normal_equations(
        problem.frames,
        state.T_lidar_radar,
        state.dt_s,
        state.sigma * widen,
        state.bounce,
        _OUTLIER,
        stride,
        state.range_bias_m,
    )
    at = problem.frames.frame
    decide = np.ix_(at, _AZIMUTH_RANGE_DOF, _AZIMUTH_RANGE_DOF)
    block = np.ix_(np.arange(len(at)), _AZIMUTH_RANGE_DOF, _AZIMUTH_RANGE_DOF)
    H[decide] += stride * equations.H[0][block]
    info[decide] += stride * equations.information[0][block]
    g[np.ix_(at, _AZIMUTH_RANGE_DOF)] += stride * equations.g[0][:, _AZIMUTH_RANGE_DOF]
    registration_step = _add_elevations(problem, equations, stride, H, info, g)
    box_sigma, mover_sigma = float("nan"), float("nan")
    if pairs is not None and problem.T_camera_lidar is not None:
        Hb, gb, box_sigma = box_equations(
            pairs, problem.T_camera_lidar, state.T_lidar_radar, state.bias_rad, F
        )
        # Roll, pitch and the biases only: a constant below the centre in metres would pass for z, and boxes' azimuths
        # were chosen by the pose.
        columns, own = (
            np.array([0, 1, *range(_RANGE + 1, _P)]),
            np.array([0, 1, *range(6, 6 + len(BOX_CLASSES))]),
        )
        for array in (H, info):
            array[np.ix_(np.arange(F), columns, columns)] += Hb[:, own[:, None], own]
        g[:, columns] += gb[:, own]
    if widen == 1.0:  # partners are found only once the clusters lie near them
        Hm, gm, mover_sigma = azimuth_equations_lidar(problem.movers, state.T_lidar_radar, state.dt_s)
        # As with static detections, azimuths say yaw, x and y; roll would come from heights that clusters lack.
        flat = _AZIMUTH_RANGE_DOF[:3]
        for array in (H, info):
            array[np.ix_(np.arange(F), flat, flat)] += Hm[:, flat[:, None], flat]
        g[:, flat] += gm[:, flat]
    prior_H, prior_g = _prior_equations(problem, state)
    boxes = 0 if pairs is None else pairs.count
    return _Linear(H, info, g, prior_H, prior_g, equations, box_sigma, boxes, mover_sigma, registration_step)


def _add_elevations(
    problem: _Problem, equations: NormalEquations, stride: int, H: np.ndarray, info: np.ndarray, g: np.ndarray
) -> np.ndarray:
    """Roll, pitch and z from the registration's elevations as one measurement with covariance `H^-1 + floor^2`.

    Returns where these elevations alone would move roll, pitch and z.
    """
    block = np.ix_(np.arange(len(problem.frames.frame)), _ELEVATION_DOF, _ELEVATION_DOF)
    He, Ie = stride * equations.H[1][block], stride * equations.information[1][block]
    ge = stride * equations.g[1][:, _ELEVATION_DOF]
    total = He.sum(0)
    # (H^-1 + F)^-1 = (1 + H F)^-1 H, which also holds where H is singular (a radar without elevation).
    temper = np.linalg.inv(np.eye(3) + total @ np.diag(problem.floor**2))
    temper_info = np.linalg.inv(np.eye(3) + Ie.sum(0) @ np.diag(problem.floor**2))
    at = problem.frames.frame
    where = np.ix_(at, _ELEVATION_DOF, _ELEVATION_DOF)
    for array, per_frame, W in ((H, He, temper), (info, Ie, temper_info)):
        product = W @ per_frame
        array[where] += 0.5 * (product + np.swapaxes(product, 1, 2))
    g[np.ix_(at, _ELEVATION_DOF)] += ge @ temper.T
    return -np.linalg.pinv(total, rcond=1e-6) @ ge.sum(0)


def _prior_equations(problem: _Problem, state: RadarState) -> tuple[np.ndarray, np.ndarray]:
    """Prior on pose (Cauchy over rotation and over translation: data may contradict it), dt and biases (Gaussian)."""
    prior = problem.prior
    x = np.zeros(_P)
    x[:6] = log_se3(state.T_lidar_radar @ np.linalg.inv(prior.T_lidar_radar))
    x[_DT] = state.dt_s
    x[_RANGE] = state.range_bias_m
    x[_RANGE + 1 :] = state.bias_rad
    weight = np.empty(_P)
    for part, sigma in ((slice(0, 3), prior.rotation_sigma_rad), (slice(3, 6), prior.translation_sigma_m)):
        weight[part] = 1 / sigma**2 / (1 + float(x[part] @ x[part]) / (2.5 * sigma) ** 2)
    weight[_DT] = 1 / problem.dt_sigma_s**2
    weight[_RANGE] = 1 / _RANGE_BIAS_SIGMA_M**2
    weight[_RANGE + 1 :] = 1 / BIAS_SIGMA_RAD**2
    return np.diag(weight), weight * x


def _elevation_floor(observations: Sequence[Observation]) -> np.ndarray:
    """Sigma of roll, pitch [rad] and z [m] that the lidar's beam spacing leaves to the registration."""
    gaps = [
        o.lidar_edge_gap_rad[(o.lidar_edge_side == EDGE_ABOVE) | (o.lidar_edge_side == EDGE_BELOW)]
        for o in observations
    ]
    every = np.concatenate(gaps) if gaps else np.zeros(0)
    spacing = float(np.median(every)) if len(every) else _DEFAULT_SPACING_RAD
    return np.array(
        [_ROLL_SPACINGS * spacing, _PITCH_SPACINGS * spacing, max(_Z_DISTANCE_M * spacing, _Z_FLOOR_M)]
    )


# -- result ----------------------------------------------------------------------------------------------------------


def _conclude(
    problem: _Problem,
    state: RadarState,
    linear: _Linear,
    ends: list[RadarState],
    halves: list[RadarState],
    covariance_camera_lidar: np.ndarray | None,
    config: SolveConfig,
    rng: np.random.Generator,
) -> PairEstimate:
    block = blocks_of(np.array([o.drive for o in problem.observations]), config.bootstrap_blocks)
    information = _with_measured_curvature(problem, state, linear.information)
    full = bootstrap_covariance(information, linear.g, linear.pull, block, rng)
    pose = full[:6, :6].copy()
    pose[np.ix_([0, 1], [0, 1])] += _camera_share(problem, covariance_camera_lidar)
    after = posterior(pose, problem.prior.covariance("lidar_radar"), _BIAS_FLOOR)
    names = np.array(["roll", "pitch", "yaw", "x", "y", "z"])
    notes = []
    if not after.observable.all():
        notes.append(f"not determined by this day, kept at the prior: {', '.join(names[~after.observable])}")
    if linear.boxes < 5:
        notes.append(
            "no vehicle boxes with radar elevations: roll and pitch rest on the registration and the prior"
        )
    else:
        notes.append("radar pitch assumes that returns lie at a constant angle (0 +- 1 deg) from box centres")
    half = log_se3(halves[0].T_lidar_radar @ np.linalg.inv(halves[1].T_lidar_radar))
    apart = log_se3(ends[0].T_lidar_radar @ np.linalg.inv(ends[-1].T_lidar_radar))
    diagnostics = {
        "azimuth_sigma_rad": float(state.sigma[0]),
        "elevation_sigma_rad": float(state.sigma[1]),
        "range_sigma_m": float(state.sigma[2]),
        "range_bias_m": state.range_bias_m,
        "range_bias_sigma_m": float(np.sqrt(full[_RANGE, _RANGE])),
        "bounce_share": state.bounce,
        "assigned_share": float(linear.registration.assigned.mean()),
        "boxes": float(linear.boxes),
        "box_sigma_rad": linear.box_sigma_rad,
        **{f"box_bias_{k}_rad": float(v) for k, v in zip(("car", "large"), state.bias_rad, strict=True)},
        "moving_azimuth_sigma_rad": linear.mover_sigma_rad,
        "registration_roll_offset_rad": float(linear.registration_step[0]),
        "registration_pitch_offset_rad": float(linear.registration_step[1]),
        "registration_roll_sigma_rad": float(problem.floor[0]),
        "registration_pitch_sigma_rad": float(problem.floor[1]),
        **{f"halves_{n}": float(v) for n, v in zip(_DOF_UNITS, half, strict=True)},
        "halves_dt_s": halves[0].dt_s - halves[1].dt_s,
        "restarts_rz_rad": float(apart[2]),
        "restarts_xy_m": float(np.hypot(apart[3], apart[4])),
    }  # fmt: skip
    return PairEstimate(
        "lidar_radar",
        state.T_lidar_radar,
        after.covariance,
        after.observability,
        after.observable,
        problem.frames.count,
        {"no static detections or lidar map": len(problem.observations) - problem.frames.count},
        state.dt_s,
        _dt_sigma(linear, full),
        {k: v for k, v in diagnostics.items() if np.isfinite(v)},
        notes,
    )


def _with_measured_curvature(problem: _Problem, state: RadarState, information: np.ndarray) -> np.ndarray:
    """Curvature over yaw, x, y, dt and range bias as the cost itself has it, from differences of its gradient.

    On days of one speed, x, dt and the range bias share a valley that is far flatter than soft assignment promises.
    """
    dof = _AZIMUTH_RANGE_DOF
    total = information.sum(0)[np.ix_(dof, dof)]
    measured = np.zeros_like(total)
    for column, k in enumerate(dof):
        step = np.zeros(_P)
        step[k] = 0.05 * _STEP_LIMIT[k]
        ahead, behind = (_gradient(problem, state.moved(s)) for s in (step, -step))
        measured[:, column] = (ahead - behind) / (2 * step[k])
    # A standing car says nothing of dt: what is added is far below any prior.
    L = np.linalg.cholesky(total + np.diag(1e-3 / _STEP_LIMIT[dof] ** 2))
    W = np.linalg.solve(L, np.linalg.solve(L, 0.5 * (measured + measured.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = L @ vectors
    out = information.copy()
    out[np.ix_(np.arange(len(out)), dof, dof)] += (
        (root * np.clip(values, 0.02, 1.0)) @ root.T - total
    ) / len(out)
    return out


def _gradient(problem: _Problem, state: RadarState) -> np.ndarray:
    g = _linearise(problem, state, 1.0, None).g
    return g.sum(0)[_AZIMUTH_RANGE_DOF]


def _dt_sigma(linear: _Linear, covariance: np.ndarray) -> float:
    """Resampled spread, floor, and ten of the steps that were still to come, for the valley is flat."""
    crawl = 10 * _step(linear, _CAUTION)[_DT]
    return float(np.sqrt(covariance[_DT, _DT] + _DT_FLOOR_S**2 + crawl**2))


def _camera_share(problem: _Problem, covariance: np.ndarray | None) -> np.ndarray:
    """Roll and pitch inherit the camera-lidar rotation's own errors through the boxes."""
    if covariance is None or problem.T_camera_lidar is None:
        return np.zeros((2, 2))
    R = problem.T_camera_lidar[:3, :3]
    return (R.T @ covariance[:3, :3] @ R)[:2, :2]
