"""Normal equations of lidar-radar: which term contributes to which degree of freedom, and the prior.

Which term determines which degree of freedom is chosen here, for measured reasons: azimuth and range of the static
registration determine yaw, x, y and dt; moving clusters add azimuth. Elevations contribute to roll,
pitch and z. The prior keeps what is left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int64

from pipeline.calibrate.joint.lidar_radar.elevation_errors import (
    added_share,
    along_radar,
    own_equations,
    radar_tilt_axes,
    tempered,
    tilt_of,
)
from pipeline.calibrate.joint.lidar_radar.problem import (
    AZIMUTH_RANGE_DOF,
    DT,
    ELEVATION_DOF,
    RANGE,
    SEEN_LOW,
    UNKNOWNS,
    UNUSED,
    Linear,
    RadarProblem,
    RadarState,
    Sums,
)
from pipeline.calibrate.numerics.nuisances import (
    OUTLIER_DENSITY,
    PRIOR_CONTRADICTION_SIGMAS,
    RANGE_BIAS_SIGMA_M,
    PartTurn,
)
from pipeline.objective.radar.heights import Heights
from pipeline.objective.radar.moving_clusters import azimuth_equations_lidar
from pipeline.objective.radar.registration import NormalEquations, normal_equations
from pipeline.objective.radar.travel import DOPPLER_PITCH_FLOOR_RAD, pitch_equations
from pipeline.objective.radar.vehicle_boxes import BIAS_SIGMA_RAD
from pipeline.rig.se3 import change_between, change_jacobian

__all__ = [
    "add_elevations", "add_heights", "add_travel", "elevation_equations", "height_equations", "linearise",
    "planar_gradient", "travel_equations", "turned",
]  # fmt: skip


def linearise(problem: RadarProblem, state: RadarState, widen: float, stride: int = 1) -> Linear:
    """Associate at a state and linearise all terms.

    Args:
        problem: the day.
        state: where.
        widen: of the registration's sigmas; only at 1 do moving clusters take part.
        stride: use every n-th static detection.
    """
    sums, equations, mover_sigma = _planar(problem, state, widen, stride)
    add_elevations(problem, state, equations, stride, sums)
    travel_scatter = add_travel(problem, state, sums)
    add_heights(problem, state, sums)
    return Linear(
        sums.H, sums.information, sums.g, *_prior_equations(problem, state), equations, mover_sigma,
        travel_scatter, sums.floors, sums.floors - sums.of_day,
    )  # fmt: skip


def planar_gradient(problem: RadarProblem, state: RadarState) -> Float[np.ndarray, " A"]:
    """Gradient of the data by AZIMUTH_RANGE_DOF, to which elevations contribute nothing."""
    g: np.ndarray = _planar(problem, state, 1.0, 1)[0].g.sum(0)
    return g[AZIMUTH_RANGE_DOF]


def _planar(
    problem: RadarProblem, state: RadarState, widen: float, stride: int
) -> tuple[Sums, NormalEquations, float]:
    """Equations of yaw, x, y, dt and range bias; all of the registration's; the sigma of movers' azimuths [rad]."""
    sums = Sums.none(len(problem.observations))
    about_radar = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    equations = _registration(problem, state, widen, stride, about_radar)
    _add_azimuths_and_ranges(problem, equations, stride, sums)
    mover_sigma = float("nan")
    if widen == 1.0 and "moving" in problem.terms:  # partners are found only once the clusters lie near them
        mover_sigma = _add_movers(problem, state, about_radar, sums)
    return sums, equations, mover_sigma


def _registration(
    problem: RadarProblem, state: RadarState, widen: float, stride: int, about_radar: np.ndarray
) -> NormalEquations:
    """Equations of the static detections about the radar; zero where `terms` leaves them out."""
    equations = _about_radar(
        about_radar,
        normal_equations(
            problem.frames, state.T_lidar_radar, state.dt_s, state.sigma * widen, state.bounce,
            OUTLIER_DENSITY, stride, state.range_bias_m,
        ),
    )  # fmt: skip
    if "static" in problem.terms:
        return equations
    return replace(equations, H=0 * equations.H, g=0 * equations.g, information=0 * equations.information)


def _add_azimuths_and_ranges(
    problem: RadarProblem, equations: NormalEquations, stride: int, sums: Sums
) -> None:
    """Yaw, x, y, dt and range bias from the registration's azimuths and ranges."""
    at = problem.frames.frame
    where = np.ix_(at, AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    block = np.ix_(np.arange(len(at)), AZIMUTH_RANGE_DOF, AZIMUTH_RANGE_DOF)
    sums.H[where] += stride * equations.H[0][block]
    sums.information[where] += stride * equations.information[0][block]
    sums.g[np.ix_(at, AZIMUTH_RANGE_DOF)] += stride * equations.g[0][:, AZIMUTH_RANGE_DOF]


def _add_movers(problem: RadarProblem, state: RadarState, about_radar: np.ndarray, sums: Sums) -> float:
    """Add moving clusters; returns the sigma of their azimuths [rad]."""
    H, g, sigma = azimuth_equations_lidar(problem.movers, state.T_lidar_radar, state.dt_s)
    H, g = turned(about_radar, H, g)
    # As with static detections, azimuths determine yaw, x and y; roll would come from heights that clusters lack.
    flat = AZIMUTH_RANGE_DOF[:3]
    for array in (sums.H, sums.information):
        array[np.ix_(np.arange(len(array)), flat, flat)] += H[:, flat[:, None], flat]
    sums.g[:, flat] += g[:, flat]
    return sigma


def _about_radar(about_radar: np.ndarray, equations: NormalEquations) -> NormalEquations:
    H, g = turned(about_radar, equations.H, equations.g)
    return replace(
        equations, H=H, g=g, information=turned(about_radar, equations.information, equations.g)[0]
    )


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
    x[SEEN_LOW] = state.seen_low - problem.seen_low.mean
    weight = np.empty(UNKNOWNS)
    turned = float(x[:3] @ x[:3]) / prior.rotation_sigma_rad**2
    weight[:3] = 1 / prior.rotation_sigma_rad**2 / (1 + turned / PRIOR_CONTRADICTION_SIGMAS**2)
    shifted = (x[3:6] / prior.translation_sigma_m) ** 2
    weight[3:6] = 1 / prior.translation_sigma_m**2 / (1 + shifted / PRIOR_CONTRADICTION_SIGMAS**2)
    weight[DT] = 1 / problem.dt_sigma_s**2
    weight[RANGE] = 1 / RANGE_BIAS_SIGMA_M**2
    weight[UNUSED] = 1 / BIAS_SIGMA_RAD**2
    weight[SEEN_LOW] = 1 / problem.seen_low.sigma**2
    return np.diag(weight), weight * x


# --------------------------------------------------------------------------------------------------
# Terms for roll, pitch and z of lidar-radar from elevations and the direction of travel, with their errors.
#
# The registration's elevations contribute no more than the lidar's own beam spacing allows (points collapse
# onto the rings, repeatably and with the lowest residual). The direction of travel adds pitch: Doppler gives it
# in radar axes, the road in lidar axes. Displaced heights add pitch as a function of the radar's height. The
# camera's vehicle boxes belong to camera-radar: the adjustment of all edges brings their roll and pitch here.


def add_travel(problem: RadarProblem, state: RadarState, sums: Sums) -> float:
    """Add the direction of travel by Doppler and road; returns its scatter over frames [rad]."""
    if problem.travel is None:
        return float("nan")
    H, g, scatter = pitch_equations(problem.travel, state.T_lidar_radar, len(sums.g))
    floor = (DOPPLER_PITCH_FLOOR_RAD**2 + problem.doubt_rad.get("doppler", 0.0) ** 2) * np.eye(2)
    _add_tilts(problem, state, "doppler", np.arange(2), H, g, floor, sums)
    return scatter


def travel_equations(problem: RadarProblem, state: RadarState) -> PartTurn | None:
    """Pitch correction from the direction of travel alone, with sigma; None if it does not determine pitch."""
    if problem.travel is None:
        return None
    H, g, _ = pitch_equations(problem.travel, state.T_lidar_radar, len(problem.observations))
    H_own, g_own = tilt_of(state.T_lidar_radar, H.sum(0), g.sum(0))
    return own_equations("doppler", H_own[1:, 1:], g_own[1:], DOPPLER_PITCH_FLOOR_RAD)


def add_heights(problem: RadarProblem, state: RadarState, sums: Sums) -> None:
    """Add static elevations, which may be displaced."""
    if problem.heights is None:
        return
    H, g = _height_equations(problem.heights, state.T_lidar_radar, len(sums.g))
    floor = problem.heights.floor_rad**2 * np.diag([1.0, 1.0, 0.0])
    _add_tilts(problem, state, "heights", ELEVATION_DOF, H, g, floor, sums)


def height_equations(problem: RadarProblem, state: RadarState) -> PartTurn | None:
    """Pitch correction from displaced heights alone, with sigma; None if they do not determine pitch."""
    if problem.heights is None:
        return None
    H, g = _height_equations(problem.heights, state.T_lidar_radar, len(problem.observations))
    H_own, g_own = tilt_of(state.T_lidar_radar, H.sum(0), g.sum(0))
    by_height = problem.heights.per_height_radpm * problem.prior.translation_sigma_m
    floor_rad = float(np.hypot(problem.heights.floor_rad, by_height))
    return own_equations("heights", H_own[1:2, 1:2], g_own[1:2], floor_rad)


def _height_equations(
    heights: Heights, T_lidar_radar: np.ndarray, frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Information (F 3 3) and gradient (F 3) of rotations about the lidar's x and y and of z.

    One number is measured: pitch as a function of the radar's height. A radar lower than assumed is rotated
    too far down, by the angle that keeps targets some 20 m away in place.
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


def add_elevations(
    problem: RadarProblem, state: RadarState, equations: NormalEquations, stride: int, sums: Sums
) -> None:
    """Roll, pitch and z from the registration's elevations as one measurement with covariance `H^-1 + floor^2`."""
    at, shape = problem.frames.frame, (len(sums.g), len(ELEVATION_DOF), len(ELEVATION_DOF))
    block = np.ix_(np.arange(len(at)), ELEVATION_DOF, ELEVATION_DOF)
    He, Ie, ge = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    He[at], Ie[at] = stride * equations.H[1][block], stride * equations.information[1][block]
    ge[at] = stride * equations.g[1][:, ELEVATION_DOF]
    # Roll follows from what stands left and right of the road: four edges of three vehicles scattered by .15 deg over
    # their 15 days, about a mean of .02, where the floor is .2. Pitch erred by .11 about -.13.
    of_day = problem.spread.roll_of_day(float(state.sigma[1])) * np.eye(3)[0]
    floors, roll = (along_radar(state.T_lidar_radar, part) for part in (_floor(problem, state), of_day))
    _add_tilts(problem, state, "registration", ELEVATION_DOF, He, ge, floors, sums, Ie, roll)


def elevation_equations(
    problem: RadarProblem, state: RadarState, equations: NormalEquations
) -> PartTurn | None:
    """Pitch correction from the registration's elevations alone; None if there are none."""
    if not problem.frames.has_elevation.any() or "static" not in problem.terms:
        return None
    block = np.ix_(np.arange(problem.frames.count), ELEVATION_DOF, ELEVATION_DOF)
    H, g = tilt_of(state.T_lidar_radar, equations.H[1][block].sum(0), equations.g[1][:, ELEVATION_DOF].sum(0))
    step = -np.linalg.pinv(H, rcond=1e-6) @ g
    return PartTurn("registration", float(step[1]), float(_floor(problem, state)[1]))


def _floor(problem: RadarProblem, state: RadarState) -> Float[np.ndarray, " 3"]:
    """Sigmas of roll, pitch and z by elevations, along the radar's axes."""
    floor = problem.spread.floor(float(state.sigma[1]), problem.spacing_rad)
    floor[1] = np.hypot(floor[1], problem.doubt_rad.get("registration", 0.0))
    return floor


def _add_tilts(
    problem: RadarProblem, state: RadarState, name: str, columns: Int64[np.ndarray, " C"],
    H: Float[np.ndarray, "F C C"], g: Float[np.ndarray, "F C"], floor: Float[np.ndarray, "C C"], sums: Sums,
    information: Float[np.ndarray, "F C C"] | None = None, of_day: Float[np.ndarray, "C C"] | None = None,
) -> None:  # fmt: skip
    """Add a source's rotations about x and y, and its other unknowns, as a measurement with covariance `H^-1 + floor`.

    Detections measured too low rotate it upwards by their share (`seen_low`).

    Args:
        problem: the day.
        state: where the equations were linearised.
        name: name of the source.
        columns: its unknowns, rotations first.
        H: EM's information of each frame, for steps.
        g: gradient.
        floor: covariance of errors common to all frames.
        sums: equations to which it is added.
        information: H reduced for uncertain assignment; None = H.
        of_day: part of the floor that differs from day to day; None = nothing.
    """
    axis = radar_tilt_axes(state.T_lidar_radar)[:, 1]
    J = added_share(axis, problem.seen_low.per_share_rad.get(name, 0.0), len(columns))
    information = H if information is None else information
    # By as much as the gradient would follow a turn: where the assignment follows it too, that is less than H.
    g = g + state.seen_low * information @ J[:, -1]
    left = tempered(information, g, floor)[0]
    H, g = tempered(H, g, floor)
    columns = np.append(columns, SEEN_LOW)
    block, every = np.ix_(columns, columns), np.ix_(np.arange(len(g)), columns, columns)
    sums.H[every] += J.T @ H @ J
    sums.information[every] += J.T @ left @ J
    sums.g[:, columns] += g @ J
    # What a floor alone scatters the total gradient by.
    whole = H.sum(0)
    sums.floors[block] += J.T @ (whole @ floor @ whole) @ J
    if of_day is not None:
        sums.of_day[block] += J.T @ (whole @ of_day @ whole) @ J


def turned(about_radar: np.ndarray, H: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equations of a left twist as equations of (rotation about the radar, shift); further unknowns are unchanged."""
    M = np.eye(g.shape[-1])
    M[:6, :6] = about_radar
    return M.T @ H @ M, g @ M
