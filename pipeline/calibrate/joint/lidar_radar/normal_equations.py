"""Normal equations of lidar-radar: which term may speak of which degree of freedom, and what the prior says.

The unknowns are counted about the radar itself: a turn R <- exp(r) R and a shift t <- t + s along the lidar's axes, as
the record shows them. A turn about the lidar's origin would carry the radar along by its lever arm, and pass an error
of pitch on to z.

Which term decides which degree of freedom is fixed here, for measured reasons: azimuth and range of the static
registration decide yaw, x, y and dt; its elevations say something of roll, pitch and z, but no more than the lidar's
own beam spacing allows (points collapse onto the rings, repeatably and with the lowest residual); the camera's vehicle
boxes decide roll, and pitch up to their constant. Moving clusters add azimuth. The prior keeps what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.config import TERMS
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_between, change_jacobian
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.geometry.spherical import to_spherical
from pipeline.objective.radar.moving_clusters import MovingClusters, azimuth_equations_lidar
from pipeline.objective.radar.registration import NormalEquations, RegistrationFrames, normal_equations
from pipeline.objective.radar.vehicle_boxes import (
    BIAS_SIGMA_RAD,
    BOX_CLASSES,
    BoxPairs,
    VehicleBoxes,
    box_equations,
)
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, Observation

__all__ = [
    "AZIMUTH_RANGE_DOF",
    "DT",
    "OUTLIER",
    "RANGE",
    "RANGE_BIAS_SIGMA_M",
    "STEP_LIMIT",
    "UNKNOWNS",
    "ElevationSpread",
    "Linear",
    "RadarProblem",
    "RadarState",
    "beam_spacing",
    "elevation_spread",
    "linearise",
    "tempered",
]

OUTLIER = 0.2  # in lidar points at distance 0: assigns about 40 % of a real radar's static detections
DT, RANGE = 6, 7
UNKNOWNS = 8 + len(BOX_CLASSES)
STEP_LIMIT = np.array([0.05] * 3 + [0.15] * 3 + [0.03, 0.1] + [0.05] * len(BOX_CLASSES))
AZIMUTH_RANGE_DOF = np.array([2, 3, 4, 6, 7])
_ELEVATION_DOF = np.array([0, 1, 5])
# How far elevations that are matched to the nearest lidar points mislead roll, pitch [rad] and z [m]. Noise takes a
# part `noise^2 / spread^2` of every mismatch away as if it were truth (regression dilution), and a mismatch is as
# large as the spread of the elevations: the angle noise^2 / spread. Real logs (3.2 deg of noise, spread 3.9): 2.6 deg
# where 1-2 deg of pitch and 4-5 deg of roll were seen; simulation (.65 deg, spread 3-6): .07-.16 deg where .01-.12 was
# seen. A coarse lidar adds a share of its beam spacing, for points collapse onto the rings. z is wrong by the same
# angle at 15 m.
_RING_SHARE, _Z_DISTANCE_M, _Z_FLOOR_M = 0.05, 15.0, 0.03
_ROLL_FACTOR = 0.7  # of pitch's at an azimuth of one radian: both sides seldom err in opposite directions
_DEFAULT_SPACING_RAD = np.radians(1.0)
RANGE_BIAS_SIGMA_M = 0.05  # radars' own, and what lies behind the surface that the lidar sees
# Roll of the boxes: which detections of a box are taken moved it by 0.5 deg on real logs. Pitch has its own unknowns.
_BOX_FLOOR = np.radians(np.array([1.0, 0.0] + [0.0] * len(BOX_CLASSES)))
_CONTRADICTED = 2.5  # prior sigmas from which data that say otherwise are believed


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
        T = self.T_lidar_radar
        return replace(
            self,
            T_lidar_radar=from_rotation_translation(exp_so3(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:6]),
            dt_s=self.dt_s + float(step[DT]),
            range_bias_m=self.range_bias_m + float(step[RANGE]),
            bias_rad=self.bias_rad + step[RANGE + 1 :],
        )

    def kept(self, prior: Prior, held: Bool[np.ndarray, " P"]) -> RadarState:
        """The state with the held pose unknowns (rotation vector from the prior, position) and dt at the prior's."""
        if not held.any():
            return self
        T0, T = prior.T_lidar_radar, self.T_lidar_radar
        turn = np.where(held[:3], 0.0, log_so3(T[:3, :3] @ T0[:3, :3].T))
        position = np.where(held[3:6], T0[:3, 3], T[:3, 3])
        return replace(
            self,
            T_lidar_radar=from_rotation_translation(exp_so3(turn) @ T0[:3, :3], position),
            dt_s=0.0 if held[DT] else self.dt_s,
        )


@dataclass(frozen=True, eq=False)
class ElevationSpread:
    """How the static detections lie: standard deviation of their elevations, RMS of their azimuths [rad]."""

    elevation_rad: float
    azimuth_rad: float

    def floor(self, noise_rad: float, spacing_rad: float) -> np.ndarray:
        """Sigma of roll, pitch [rad] and z [m] that such elevation noise leaves to the registration."""
        angle = np.hypot(noise_rad**2 / self.elevation_rad, _RING_SHARE * spacing_rad)
        roll, z_m = _ROLL_FACTOR * angle / self.azimuth_rad, np.hypot(_Z_DISTANCE_M * angle, _Z_FLOOR_M)
        return np.array([roll, angle, z_m])


@dataclass(frozen=True, eq=False)
class RadarProblem:
    """All that stays the same while the state moves."""

    observations: Sequence[Observation]
    frames: RegistrationFrames
    movers: MovingClusters
    boxes: VehicleBoxes
    T_camera_lidar: np.ndarray | None
    prior: Prior
    dt_sigma_s: float
    spacing_rad: float  # of the lidar's beams, vertically
    spread: ElevationSpread
    terms: Sequence[str] = TERMS  # that take part

    def of_frames(self, index: np.ndarray) -> RadarProblem:
        """The same with part of the registration's frames (and of the observations behind them)."""
        chosen = self.frames.frame[index]
        part = [self.observations[i] for i in chosen]
        frames = replace(self.frames.subset(index), frame=np.arange(len(index), dtype=np.int64))
        return replace(
            self,
            observations=part,
            frames=frames,
            movers=self.movers.of_frames(chosen),
            boxes=self.boxes.of_frames(chosen),
        )


@dataclass(frozen=True, eq=False)
class Linear:
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
    floor: np.ndarray  # sigma of roll, pitch, z as the registration's elevations give them


def linearise(
    problem: RadarProblem, state: RadarState, widen: float, pairs: BoxPairs | None, stride: int = 1
) -> Linear:
    """Associate at a state and linearise all terms.

    Args:
        problem: the day.
        state: where.
        widen: of the registration's sigmas; only at 1 do moving clusters take part.
        pairs: detections in vehicle boxes.
        stride: use every n-th static detection.
    """
    F = len(problem.observations)
    H, info, g = np.zeros((F, UNKNOWNS, UNKNOWNS)), np.zeros((F, UNKNOWNS, UNKNOWNS)), np.zeros((F, UNKNOWNS))
    about_radar = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    equations = _about_radar(
        about_radar,
        normal_equations(
            problem.frames,
            state.T_lidar_radar,
            state.dt_s,
            state.sigma * widen,
            state.bounce,
            OUTLIER,
            stride,
            state.range_bias_m,
        ),
    )
    if "static" not in problem.terms:
        equations = replace(
            equations, H=0 * equations.H, g=0 * equations.g, information=0 * equations.information
        )
    at = problem.frames.frame
    decide = np.ix_(at, AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    block = np.ix_(np.arange(len(at)), AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    H[decide] += stride * equations.H[0][block]
    info[decide] += stride * equations.information[0][block]
    g[np.ix_(at, AZIMUTH_RANGE_DOF)] += stride * equations.g[0][:, AZIMUTH_RANGE_DOF]
    floor = problem.spread.floor(float(state.sigma[1]), problem.spacing_rad)
    registration_step = _add_elevations(problem, equations, stride, floor, H, info, g)
    box_sigma = _add_boxes(problem, state, pairs, about_radar, H, info, g)
    mover_sigma = float("nan")
    if widen == 1.0 and "moving" in problem.terms:  # partners are found only once the clusters lie near them
        Hm, gm, mover_sigma = azimuth_equations_lidar(problem.movers, state.T_lidar_radar, state.dt_s)
        Hm, gm = _turned(about_radar, Hm, gm)
        # As with static detections, azimuths say yaw, x and y; roll would come from heights that clusters lack.
        flat = AZIMUTH_RANGE_DOF[:3]
        for array in (H, info):
            array[np.ix_(np.arange(F), flat, flat)] += Hm[:, flat[:, None], flat]
        g[:, flat] += gm[:, flat]
    prior_H, prior_g = _prior_equations(problem, state)
    boxes = 0 if pairs is None else pairs.count
    return Linear(
        H, info, g, prior_H, prior_g, equations, box_sigma, boxes, mover_sigma, registration_step, floor
    )


def _about_radar(about_radar: np.ndarray, equations: NormalEquations) -> NormalEquations:
    H, g = _turned(about_radar, equations.H, equations.g)
    return replace(
        equations, H=H, g=g, information=_turned(about_radar, equations.information, equations.g)[0]
    )


def _turned(about_radar: np.ndarray, H: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equations of a left twist as equations of (turn about the radar, shift); further unknowns stay."""
    M = np.eye(g.shape[-1])
    M[:6, :6] = about_radar
    return M.T @ H @ M, g @ M


def _add_boxes(
    problem: RadarProblem,
    state: RadarState,
    pairs: BoxPairs | None,
    about_radar: np.ndarray,
    H: np.ndarray,
    info: np.ndarray,
    g: np.ndarray,
) -> float:
    """Add what vehicle boxes say; returns the sigma of a detection's elevation in its box [rad]."""
    if pairs is None or problem.T_camera_lidar is None:
        return float("nan")
    F = len(g)
    Hb, gb, sigma = box_equations(pairs, problem.T_camera_lidar, state.T_lidar_radar, state.bias_rad, F)
    Hb, gb = _turned(about_radar, Hb, gb)
    # Roll, pitch and the biases only: a constant below the centre in metres would pass for z, and boxes' azimuths
    # were chosen by the pose.
    columns = np.array([0, 1, *range(RANGE + 1, UNKNOWNS)])
    own = np.array([0, 1, *range(6, 6 + len(BOX_CLASSES))])
    Hb, gb = tempered(Hb[:, own[:, None], own], gb[:, own], _BOX_FLOOR)
    for array in (H, info):
        array[np.ix_(np.arange(F), columns, columns)] += Hb
    g[:, columns] += gb
    return sigma


def _add_elevations(
    problem: RadarProblem,
    equations: NormalEquations,
    stride: int,
    floor: np.ndarray,
    H: np.ndarray,
    info: np.ndarray,
    g: np.ndarray,
) -> np.ndarray:
    """Roll, pitch and z from the registration's elevations as one measurement with covariance `H^-1 + floor^2`.

    Returns where these elevations alone would move roll, pitch and z.
    """
    block = np.ix_(np.arange(len(problem.frames.frame)), _ELEVATION_DOF, _ELEVATION_DOF)
    He, Ie = stride * equations.H[1][block], stride * equations.information[1][block]
    ge = stride * equations.g[1][:, _ELEVATION_DOF]
    at = problem.frames.frame
    where = np.ix_(at, _ELEVATION_DOF, _ELEVATION_DOF)
    He_t, ge_t = tempered(He, ge, floor)
    H[where] += He_t
    info[where] += tempered(Ie, ge, floor)[0]
    g[np.ix_(at, _ELEVATION_DOF)] += ge_t
    return -np.linalg.pinv(He.sum(0), rcond=1e-6) @ ge.sum(0)


def tempered(
    H: Float[np.ndarray, "F P P"], g: Float[np.ndarray, "F P"], floor: Float[np.ndarray, " P"]
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"]]:
    """Equations of all frames as one measurement with covariance `H^-1 + floor^2`, shared out among the frames."""
    # (H^-1 + F)^-1 = (1 + H F)^-1 H, which also holds where H is singular (a radar without elevation).
    W = np.linalg.inv(np.eye(len(floor)) + H.sum(0) @ np.diag(floor**2))
    product = W @ H
    return 0.5 * (product + np.swapaxes(product, 1, 2)), g @ W.T


def _prior_equations(problem: RadarProblem, state: RadarState) -> tuple[np.ndarray, np.ndarray]:
    """Prior on pose (Cauchy: data may contradict it), dt and biases (Gaussian).

    Rotation as a whole and every axis of the position lose weight on their own: a z that elevations mislead is no
    reason to doubt x and y, nor the other way round.
    """
    prior = problem.prior
    x = np.zeros(UNKNOWNS)
    x[:6] = change_between(prior.T_lidar_radar, state.T_lidar_radar)
    x[DT] = state.dt_s
    x[RANGE] = state.range_bias_m
    x[RANGE + 1 :] = state.bias_rad
    weight = np.empty(UNKNOWNS)
    turned = float(x[:3] @ x[:3]) / prior.rotation_sigma_rad**2
    weight[:3] = 1 / prior.rotation_sigma_rad**2 / (1 + turned / _CONTRADICTED**2)
    shifted = (x[3:6] / prior.translation_sigma_m) ** 2
    weight[3:6] = 1 / prior.translation_sigma_m**2 / (1 + shifted / _CONTRADICTED**2)
    weight[DT] = 1 / problem.dt_sigma_s**2
    weight[RANGE] = 1 / RANGE_BIAS_SIGMA_M**2
    weight[RANGE + 1 :] = 1 / BIAS_SIGMA_RAD**2
    return np.diag(weight), weight * x


def beam_spacing(observations: Sequence[Observation]) -> float:
    """Vertical spacing of the lidar's beams [rad], as its depth jumps between rings show it."""
    gaps = [
        o.lidar_edge_gap_rad[(o.lidar_edge_side == EDGE_ABOVE) | (o.lidar_edge_side == EDGE_BELOW)]
        for o in observations
    ]
    every = np.concatenate(gaps) if gaps else np.zeros(0)
    return float(np.median(every)) if len(every) else float(_DEFAULT_SPACING_RAD)


def elevation_spread(frames: RegistrationFrames) -> ElevationSpread:
    """How the static detections of these frames lie."""
    azimuth, elevation, _ = to_spherical(frames.radar_m).T
    # One degree: below it, noise alone would make as much.
    return ElevationSpread(
        max(float(np.std(elevation)), np.radians(1.0)),
        max(float(np.sqrt(np.mean(azimuth**2))), np.radians(3.0)),
    )
