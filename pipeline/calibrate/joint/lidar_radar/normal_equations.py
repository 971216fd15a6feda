"""Normal equations of lidar-radar: which term contributes to which degree of freedom, and the prior.

The unknowns are counted about the radar itself: a turn R <- exp(r) R and a shift t <- t + s along the lidar's axes, as
the record shows them. A turn about the lidar's origin would carry the radar along by its lever arm, and pass an error
of pitch on to z.

Which term determines which degree of freedom is chosen here, for measured reasons: azimuth and range of the static
registration determine yaw, x, y and dt; its elevations contribute to roll, pitch and z, but no more than the lidar's
own beam spacing allows (points collapse onto the rings, repeatably and with the lowest residual); the camera's vehicle
boxes determine roll, and pitch up to their constant. Moving clusters add azimuth. The way that the car drives adds
pitch: Doppler knows it in radar axes, the road in lidar axes. The prior keeps what is left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.lidar_radar.elevation_spread import ElevationSpread
from pipeline.calibrate.joint.lidar_radar.tilt_floors import (
    along_radar,
    floor_scatter,
    radar_tilt_axes,
    tempered,
    tilt_of,
)
from pipeline.calibrate.joint.lidar_radar.witnesses import Witness, own_opinion
from pipeline.calibrate.numerics.bias_floors import (
    BOX_ROLL_FLOOR_LIDAR_RAD,
    OUTLIER_DENSITY,
    PRIOR_CONTRADICTION_SIGMAS,
    RANGE_BIAS_SIGMA_M,
)
from pipeline.config import TERMS
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_between, change_jacobian
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.objective.radar.heights import HEIGHTS_PITCH_FLOOR_RAD, Heights
from pipeline.objective.radar.moving_clusters import MovingClusters, azimuth_equations_lidar
from pipeline.objective.radar.registration import NormalEquations, RegistrationFrames, normal_equations
from pipeline.objective.radar.travel import TravelDirections, pitch_equations
from pipeline.objective.radar.vehicle_boxes import (
    BIAS_SIGMA_RAD,
    BOX_CLASSES,
    BoxPairs,
    VehicleBoxes,
    box_equations,
)
from schemas.observations import Observation

__all__ = [
    "AZIMUTH_RANGE_DOF",
    "DT",
    "ELEVATION_DOF",
    "RANGE",
    "STEP_LIMIT",
    "UNKNOWNS",
    "Linear",
    "RadarProblem",
    "RadarState",
    "height_opinion",
    "linearise",
    "travel_opinion",
]

DT, RANGE = 6, 7
UNKNOWNS = 8 + len(BOX_CLASSES)
STEP_LIMIT = np.array([0.05] * 3 + [0.15] * 3 + [0.03, 0.1] + [0.05] * len(BOX_CLASSES))
AZIMUTH_RANGE_DOF = np.array([2, 3, 4, 6, 7])
ELEVATION_DOF = np.array([0, 1, 5])
# Roll and pitch of the boxes, and their constants: pitch has unknowns of its own.
_BOX_FLOOR = np.array([BOX_ROLL_FLOOR_LIDAR_RAD, 0.0] + [0.0] * len(BOX_CLASSES))


@dataclass(frozen=True, eq=False)
class RadarState:
    """The unknowns as estimated so far, and the radar's sigmas."""

    T_lidar_radar: np.ndarray  # 4 4
    dt_s: float
    range_bias_m: float
    bias_rad: np.ndarray  # elevation of returns from the box's centre, by class
    sigma: np.ndarray  # 3: azimuth [rad], elevation [rad], range [m]
    bounce: float  # share of detections that are mirrored in the road

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

    def with_fixed(self, prior: Prior, fixed: Bool[np.ndarray, " P"]) -> RadarState:
        """The state with its fixed unknowns (rotation vector from the prior, position, dt) back at the prior."""
        if not fixed.any():
            return self
        T0, T = prior.T_lidar_radar, self.T_lidar_radar
        turn = np.where(fixed[:3], 0.0, log_so3(T[:3, :3] @ T0[:3, :3].T))
        position = np.where(fixed[3:6], T0[:3, 3], T[:3, 3])
        return replace(
            self,
            T_lidar_radar=from_rotation_translation(exp_so3(turn) @ T0[:3, :3], position),
            dt_s=0.0 if fixed[DT] else self.dt_s,
        )


@dataclass(frozen=True, eq=False)
class RadarProblem:
    """All that stays the same while the state changes."""

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
    # Of the stamps [s], taken out of all frames' gaps: the state's dt counts from minus it, as if the clocks were off.
    constant_gap_s: float = 0.0
    travel: TravelDirections | None = None  # None until the pose is near enough to measure them
    heights: Heights | None = None  # likewise
    doubt_rad: Mapping[str, float] = field(default_factory=dict)  # of pitch, beyond a witness's own sigma

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
            travel=None if self.travel is None else self.travel.of_frames(chosen),
            heights=None if self.heights is None else self.heights.of_frames(chosen),
        )


@dataclass(frozen=True, eq=False)
class Linear:
    """Normal equations per observation at one state, and what came with them."""

    H: np.ndarray  # F P P, EM's: for steps
    information: np.ndarray  # F P P, what uncertain assignment leaves of it
    g: np.ndarray  # F P, gradient of the cost
    prior_information: np.ndarray  # P P
    prior_gradient: np.ndarray  # P
    registration: NormalEquations
    box_sigma_rad: float
    boxes: int
    mover_sigma_rad: float
    # 3: where the registration's elevations alone would move roll, pitch (about the radar's own axes), z
    registration_step: np.ndarray
    floor: np.ndarray  # 3: sigma that those elevations leave of roll, pitch [rad] and z [m]
    witnesses: tuple[Witness, ...]  # of pitch
    travel_frames: int
    travel_scatter_rad: float  # of the frames' ways beyond their own sigmas
    # P P: scatter of the total gradient by what all frames of elevation's sources err by; of that, what all days share.
    floors: np.ndarray
    floors_alike: np.ndarray


@dataclass(eq=False)
class _Sums:
    """Equations per observation while terms are added."""

    H: np.ndarray  # F P P
    information: np.ndarray  # F P P
    g: np.ndarray  # F P
    floors: np.ndarray  # P P
    of_day: np.ndarray  # P P, of the floors what is another on every day


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
    sums = _Sums(
        np.zeros((F, UNKNOWNS, UNKNOWNS)),
        np.zeros((F, UNKNOWNS, UNKNOWNS)),
        np.zeros((F, UNKNOWNS)),
        np.zeros((UNKNOWNS, UNKNOWNS)),
        np.zeros((UNKNOWNS, UNKNOWNS)),
    )
    about_radar = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    equations = _registration(problem, state, widen, stride, about_radar)
    _add_azimuths_and_ranges(problem, equations, stride, sums)
    floor = problem.spread.floor(float(state.sigma[1]), problem.spacing_rad)
    floor[1] = np.hypot(floor[1], problem.doubt_rad.get("registration", 0.0))
    registration_step = _add_elevations(problem, state, equations, stride, floor, sums)
    box_sigma, box_witness = _add_boxes(problem, state, pairs, about_radar, sums)
    travel_scatter, travel_witness = _add_travel(problem, state, sums)
    height_witness = _add_heights(problem, state, sums)
    own = Witness("registration", float(registration_step[1]), float(floor[1]))
    seen = own if problem.frames.has_elevation.any() and "static" in problem.terms else None
    mover_sigma = float("nan")
    if widen == 1.0 and "moving" in problem.terms:  # partners are found only once the clusters lie near them
        mover_sigma = _add_movers(problem, state, about_radar, sums)
    prior_information, prior_gradient = _prior_equations(problem, state)
    return Linear(
        sums.H,
        sums.information,
        sums.g,
        prior_information,
        prior_gradient,
        equations,
        box_sigma,
        0 if pairs is None else pairs.count,
        mover_sigma,
        registration_step,
        floor,
        tuple(w for w in (seen, box_witness, travel_witness, height_witness) if w is not None),
        0 if travel_witness is None or problem.travel is None else problem.travel.count,
        travel_scatter,
        sums.floors,
        sums.floors - sums.of_day,
    )


def _registration(
    problem: RadarProblem, state: RadarState, widen: float, stride: int, about_radar: np.ndarray
) -> NormalEquations:
    """Equations of the static detections about the radar; zero where `terms` leaves them out."""
    equations = _about_radar(
        about_radar,
        normal_equations(
            problem.frames,
            state.T_lidar_radar,
            state.dt_s,
            state.sigma * widen,
            state.bounce,
            OUTLIER_DENSITY,
            stride,
            state.range_bias_m,
        ),
    )
    if "static" in problem.terms:
        return equations
    return replace(equations, H=0 * equations.H, g=0 * equations.g, information=0 * equations.information)


def _add_azimuths_and_ranges(
    problem: RadarProblem, equations: NormalEquations, stride: int, sums: _Sums
) -> None:
    """Yaw, x, y, dt and range bias from the registration's azimuths and ranges."""
    at = problem.frames.frame
    where = np.ix_(at, AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    block = np.ix_(np.arange(len(at)), AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    sums.H[where] += stride * equations.H[0][block]
    sums.information[where] += stride * equations.information[0][block]
    sums.g[np.ix_(at, AZIMUTH_RANGE_DOF)] += stride * equations.g[0][:, AZIMUTH_RANGE_DOF]


def _add_movers(problem: RadarProblem, state: RadarState, about_radar: np.ndarray, sums: _Sums) -> float:
    """Add moving clusters; returns the sigma of their azimuths [rad]."""
    H, g, sigma = azimuth_equations_lidar(problem.movers, state.T_lidar_radar, state.dt_s)
    H, g = _turned(about_radar, H, g)
    # As with static detections, azimuths determine yaw, x and y; roll would come from heights that clusters lack.
    flat = AZIMUTH_RANGE_DOF[:3]
    for array in (sums.H, sums.information):
        array[np.ix_(np.arange(len(array)), flat, flat)] += H[:, flat[:, None], flat]
    sums.g[:, flat] += g[:, flat]
    return sigma


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
    sums: _Sums,
) -> tuple[float, Witness | None]:
    """Add the camera's vehicle boxes; returns an elevation's sigma in its box [rad], and what they say of pitch."""
    if pairs is None or problem.T_camera_lidar is None:
        return float("nan"), None
    F = len(sums.g)
    Hb, gb, sigma = box_equations(pairs, problem.T_camera_lidar, state.T_lidar_radar, state.bias_rad, F)
    Hb, gb = _turned(about_radar, Hb, gb)
    # Roll, pitch and the biases only: a constant offset below the centre in metres would look like z, and boxes were
    # matched by azimuth at this pose.
    columns = np.array([0, 1, *range(RANGE + 1, UNKNOWNS)])
    own = np.array([0, 1, *range(6, 6 + len(BOX_CLASSES))])
    Hb, gb = Hb[:, own[:, None], own], gb[:, own]
    prior = np.diag([0.0, *[1 / BIAS_SIGMA_RAD**2] * len(BOX_CLASSES)])
    H_own, g_own = tilt_of(state.T_lidar_radar, Hb.sum(0), gb.sum(0))
    witness = own_opinion("boxes", H_own[1:, 1:] + prior, g_own[1:] + prior @ [0.0, *state.bias_rad], 0.0)
    doubt_rad = problem.doubt_rad.get("boxes", 0.0)
    floor = along_radar(state.T_lidar_radar, _BOX_FLOOR + doubt_rad * (np.arange(len(_BOX_FLOOR)) == 1))
    Hb, gb = tempered(Hb, gb, floor)
    sums.floors[np.ix_(columns, columns)] += floor_scatter(Hb, floor)
    for array in (sums.H, sums.information):
        array[np.ix_(np.arange(F), columns, columns)] += Hb
    sums.g[:, columns] += gb
    return sigma, witness


def _add_travel(problem: RadarProblem, state: RadarState, sums: _Sums) -> tuple[float, Witness | None]:
    """Add the car's way by Doppler and road; returns its scatter over the frames [rad], and what it says of pitch."""
    if problem.travel is None:
        return float("nan"), None
    H, g, scatter = pitch_equations(problem.travel, state.T_lidar_radar, len(sums.g))
    witness = travel_opinion(problem, state)
    floor = (problem.travel.bias_rad**2 + problem.doubt_rad.get("doppler", 0.0) ** 2) * np.eye(2)
    H, g = tempered(H, g, floor)
    sums.floors[:2, :2] += floor_scatter(H, floor)
    for array in (sums.H, sums.information):
        array[:, :2, :2] += H
    sums.g[:, :2] += g
    return scatter, witness


def travel_opinion(problem: RadarProblem, state: RadarState) -> Witness | None:
    """What the car's way says of pitch at a state; None where it says nothing."""
    if problem.travel is None:
        return None
    H, g, _ = pitch_equations(problem.travel, state.T_lidar_radar, len(problem.observations))
    H_own, g_own = tilt_of(state.T_lidar_radar, H.sum(0), g.sum(0))
    return own_opinion("doppler", H_own[1:, 1:], g_own[1:], problem.travel.bias_rad)


def _add_heights(problem: RadarProblem, state: RadarState, sums: _Sums) -> Witness | None:
    """Add what static elevations say of pitch that may be displaced; returns what they say of it at this state."""
    if problem.heights is None:
        return None
    H, g = _height_equations(problem.heights, state.T_lidar_radar, len(sums.g))
    witness = height_opinion(problem, state)
    floor = HEIGHTS_PITCH_FLOOR_RAD**2 * np.diag([1.0, 1.0, 0.0])
    H, g = tempered(H, g, floor)
    sums.floors[np.ix_(ELEVATION_DOF, ELEVATION_DOF)] += floor_scatter(H, floor)
    for array in (sums.H, sums.information):
        array[np.ix_(np.arange(len(H)), ELEVATION_DOF, ELEVATION_DOF)] += H
    sums.g[:, ELEVATION_DOF] += g
    return witness


def height_opinion(problem: RadarProblem, state: RadarState) -> Witness | None:
    """What displaced heights say of pitch at a state; None where they say nothing."""
    if problem.heights is None:
        return None
    H, g = _height_equations(problem.heights, state.T_lidar_radar, len(problem.observations))
    H_own, g_own = tilt_of(state.T_lidar_radar, H.sum(0), g.sum(0))
    by_height = problem.heights.per_height_radpm * problem.prior.translation_sigma_m
    floor_rad = float(np.hypot(HEIGHTS_PITCH_FLOOR_RAD, by_height))
    return own_opinion("heights", H_own[1:2, 1:2], g_own[1:2], floor_rad)


def _height_equations(
    heights: Heights, T_lidar_radar: np.ndarray, frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Information (F 3 3) and gradient (F 3) of turns about the lidar's x and y and of z.

    One number is measured: pitch as the radar's height makes it. A radar that is lower than it is taken for is turned
    too far down by so much that targets some 20 m away stay where they are.
    """
    axis = radar_tilt_axes(T_lidar_radar)[:, 1]
    turned = float(change_between(heights.T_lidar_radar, T_lidar_radar)[:2] @ axis)
    higher_m = T_lidar_radar[2, 3] - heights.T_lidar_radar[2, 3]
    residual = turned - heights.turn_rad - heights.per_height_radpm * higher_m
    J = np.append(axis, -heights.per_height_radpm)
    H, g = np.zeros((frames, 3, 3)), np.zeros((frames, 3))
    each = heights.frames
    H[each.frame] = each.information[:, None, None] * np.outer(J, J)
    g[each.frame] = (each.score + each.information * residual)[:, None] * J
    return H, g


def _add_elevations(
    problem: RadarProblem,
    state: RadarState,
    equations: NormalEquations,
    stride: int,
    floor: np.ndarray,
    sums: _Sums,
) -> np.ndarray:
    """Roll, pitch and z from the registration's elevations as one measurement with covariance `H^-1 + floor^2`.

    Floors and what is returned, where these elevations alone would move roll, pitch and z, are along the radar's axes.
    """
    block = np.ix_(np.arange(len(problem.frames.frame)), ELEVATION_DOF, ELEVATION_DOF)
    He, Ie = stride * equations.H[1][block], stride * equations.information[1][block]
    ge = stride * equations.g[1][:, ELEVATION_DOF]
    at = problem.frames.frame
    where = np.ix_(at, ELEVATION_DOF, ELEVATION_DOF)
    floors = along_radar(state.T_lidar_radar, floor)
    He_t, ge_t = tempered(He, ge, floors)
    sums.H[where] += He_t
    sums.information[where] += tempered(Ie, ge, floors)[0]
    sums.floors[np.ix_(ELEVATION_DOF, ELEVATION_DOF)] += floor_scatter(He_t, floors)
    # Roll follows from what stands left and right of the road: four edges of three vehicles scattered by .15 deg over
    # their 15 days, about a mean of .02, where the floor is .2. Pitch erred by .11 about -.13.
    roll = along_radar(state.T_lidar_radar, floor * [1.0, 0.0, 0.0])
    sums.of_day[np.ix_(ELEVATION_DOF, ELEVATION_DOF)] += floor_scatter(He_t, roll)
    sums.g[np.ix_(at, ELEVATION_DOF)] += ge_t
    H_own, g_own = tilt_of(state.T_lidar_radar, He.sum(0), ge.sum(0))
    return np.asarray(-np.linalg.pinv(H_own, rcond=1e-6) @ g_own)


def _prior_equations(problem: RadarProblem, state: RadarState) -> tuple[np.ndarray, np.ndarray]:
    """Prior on pose (Cauchy: data may contradict it), dt and biases (Gaussian).

    Rotation as a whole and every axis of the position lose weight separately: a z that elevations mislead is no reason
    to trust the prior's x and y less, nor the other way round.
    """
    prior = problem.prior
    x = np.zeros(UNKNOWNS)
    x[:6] = change_between(prior.T_lidar_radar, state.T_lidar_radar)
    x[DT] = state.dt_s
    x[RANGE] = state.range_bias_m
    x[RANGE + 1 :] = state.bias_rad
    weight = np.empty(UNKNOWNS)
    turned = float(x[:3] @ x[:3]) / prior.rotation_sigma_rad**2
    weight[:3] = 1 / prior.rotation_sigma_rad**2 / (1 + turned / PRIOR_CONTRADICTION_SIGMAS**2)
    shifted = (x[3:6] / prior.translation_sigma_m) ** 2
    weight[3:6] = 1 / prior.translation_sigma_m**2 / (1 + shifted / PRIOR_CONTRADICTION_SIGMAS**2)
    weight[DT] = 1 / problem.dt_sigma_s**2
    weight[RANGE] = 1 / RANGE_BIAS_SIGMA_M**2
    weight[RANGE + 1 :] = 1 / BIAS_SIGMA_RAD**2
    return np.diag(weight), weight * x
