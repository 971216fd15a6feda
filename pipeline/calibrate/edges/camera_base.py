"""Edge camera-base: mounting of a camera on the car, from how its images show the car's motion.

In straight driving the camera's translation is the base's x axis: yaw and pitch. In turns the camera also moves by
the turn times its lever arm, as a radar does (`radar_base`). The axis about which the camera turns is the base's z
axis: roll and pitch, over turns; a body leans by so much a g in them. The body's own pitch and roll are means over
scenes. The amount of turn is compared with the car's yaw rate: over changes of the yaw rate it determines the clock,
over turns a scale, which is that of the focal length. Position has no information. Labels, depths and other sensors'
poses take no part, so the errors are this edge's own; an error of the intrinsics turns what any edge of it shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from pipeline.calibrate.edges.camera_travel import CameraTravel, camera_travel
from pipeline.calibrate.edges.on_base import (
    STANCE,
    DaySources,
    Regression,
    Rows,
    Series,
    changes_by_left,
    first_and_last,
    of_stance_and,
    other_scenes,
    regress,
)
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.numerics.nuisances import Considered, by_sensor
from pipeline.calibrate.reasons import because
from pipeline.core.errors import SolveError
from pipeline.rig.estimates import Check, EdgeEvidence
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, log_so3

__all__ = ["FEWEST", "elsewhere", "estimate_camera_base", "solve"]

# A body pitches and yaws so much from image to image, however sharp the tracks are.
_LEAST_RAD = np.radians(0.1)
_LEVER_SIGMA_M = 1.5  # as of a radar: place of the rear axle, slip
_ROLL_AXIS_M, _HEIGHT_SIGMA_M = 0.4, 0.5  # about which a body rolls, over the road
_NO_SCALE, _DRIFT_SIGMA_RADPS = 1.0, 0.003  # of a yaw rate beside the camera's
_MOST_TURN_RAD = np.radians(0.6)  # a metre, of a car of which nothing shows the way: straight driving
_TURNING_RAD = np.radians(0.4)
# Of yaw: free; lever arm, height [m]; what the base's turn is off by: scale, clock [s], drift [rad/s].
_YAW_PRIORS = np.array([np.inf, _LEVER_SIGMA_M, _HEIGHT_SIGMA_M, 0.02, 0.05, 0.0007])
_WAY_M = 3.0  # between two images of a car of which nothing shows it: what ingest looks for
_BEND_M = 50.0
_FLOOR_RAD = np.radians(0.02)  # of yaw and pitch by matching, as of radars
_ROLL_FLOOR_RAD = np.radians(0.05)  # roads that lean to one side in bends
# By which a body leans outward for each g: cars by 3 to 7 deg (Gillespie 1992), less where a road leans inward. The
# real car leans by 7 to 8 in a bend of .36 g.
_LEAN_RAD, _LEAN_SIGMA_RAD, _G_MPS2 = np.radians(5.0), np.radians(3.0), 9.81
# By which roads turn a body up or down from image to image within one bend: .1 deg in 3 m is a crest of 1.7 km radius.
# It passed for a roll of 2 to 7 deg in bends of 1 deg a pair (five days, all cameras alike).
_HILL_RAD = np.radians(0.1)
_CENTRE_RAD = np.radians(0.03)  # by principal point and focal length
# Yaw of twelve side cameras (seeds 7423, 7427) was .09 deg RMS off beside its noise, mostly outward; less of those that
# look ahead or back.
_ASIDE_RAD = np.radians(0.1)
# A worse clock is none: those of side cameras were 10 to 300 ms off at stated 32 to 141 (days 6701 to 6712).
_CLOCK_FLOOR_S, _MOST_CLOCK_S, _NO_CLOCK_S = 0.002, 0.025, 1.0
FEWEST = 8
_BY_WAY = ("yaw", "pitch")
_PASSES = 4
# Of a start for a search: from 120 deg off four rounds arrive. Half a turn may be a mirrored image.
_ROUNDS, _SURE_SIGMAS, _OPEN, _MIRRORED_RAD = 4, 3.0, 0.1, np.radians(150.0)


def solve(edge: Edge, sources: DaySources) -> tuple[EdgeEvidence, int]:
    """Evidence of a day, and its number of moments; raises SolveError if there are too few."""
    travel, moments = _travel(edge, sources)
    T, by_turns = sources.on_base(edge.parent.name), not sources.prior.is_base_loose
    return estimate_camera_base(edge, travel, T, by_turns=by_turns), moments


def elsewhere(edge: Edge, sources: DaySources, reach_rad: float) -> Float[np.ndarray, "4 4"] | None:
    """T_base_camera by motion alone, if its prior is surely more than `reach_rad` off about an axis.

    A search begins there: it is no measurement, since bodies lean in the turns that take part. What the day does not
    determine, as roll on straight roads, stays at the prior. None if the prior is near, or few images show a motion.
    """
    try:
        prior, (travel, _) = sources.on_base(edge.parent.name), _travel(edge, sources)
        found = estimate_camera_base(edge, travel, prior)
        if not _is_farther(found, prior, reach_rad, sigmas=0.0):
            return None
        for _ in range(_ROUNDS):
            found = estimate_camera_base(edge, travel, inverse(found.T))
    except SolveError:
        return None
    is_sure = not found.checks and _is_farther(found, prior, reach_rad, _SURE_SIGMAS)
    return inverse(found.T) if is_sure else None


def _is_farther(found: EdgeEvidence, T_base_camera: np.ndarray, reach_rad: float, sigmas: float) -> bool:
    turn = log_so3(found.T[:3, :3] @ T_base_camera[:3, :3])
    information, axes = np.linalg.eigh(found.information[:3, :3])
    sigma = 1 / np.sqrt(np.maximum(information, _OPEN))
    beyond = np.abs(turn @ axes) > reach_rad + sigmas * sigma
    return bool(beyond.any() and np.linalg.norm(turn) < _MIRRORED_RAD)


def _travel(edge: Edge, sources: DaySources) -> tuple[CameraTravel, int]:
    """Motion of the camera and the base, and the number of the camera's moments; SolveError if it is silent."""
    name = edge.parent.name
    if name not in sources.read:
        rows = sources.rows({"camera": name})
        if not rows:
            raise SolveError(because("silent", sensor=name, what="image"), "silent_sensor")
        travel = camera_travel(rows, sources.ego_at(rows), Scenes.of(rows))
        if sources.prior.is_base_loose and not any(o.ego_turned_rad is not None for o in rows):
            unknown = travel.turned_rad * np.nan  # Doppler's yaw rate: by a lever that nobody measured
            travel = replace(travel, turned_rad=unknown, turned_by_clock_radps=unknown)
        sources.read[name] = travel, len(rows)
    known: tuple[CameraTravel, int] = sources.read[name]
    return known


def estimate_camera_base(
    edge: Edge, travel: CameraTravel, T_base_camera: Float[np.ndarray, "4 4"], *, by_turns: bool = True
) -> EdgeEvidence:
    """Evidence of a day on T_camera_base and on the base's clock.

    Args:
        T_base_camera: the start, whose rotation does not contribute to the information.
        by_turns: whether axes and amounts of turns take part: bodies lean in bends, 2.4 deg on a real car.

    Raises:
        SolveError: too few pairs of images show a motion.
    """
    if len(travel.span_s) < FEWEST:
        counts = {"used": len(travel.span_s), "needed": FEWEST}
        raise SolveError(because("few image pairs", camera=edge.parent.name, **counts), "few_scenes")
    T = T_base_camera
    for _ in range(_PASSES):
        rows = _rows(travel, T)
        fits = {name: regress(of) if by_turns or name in _BY_WAY else None for name, of in rows.items()}
        change, variance = _combined(fits)
        T = from_rotation_translation(exp_so3(change) @ T[:3, :3], T[:3, 3])
    clock = _clock(travel, T) if by_turns else None
    timed = None if clock is None or clock.covariance[0, 0] > _MOST_CLOCK_S**2 else clock
    J = np.zeros((4, 7))
    J[:3, :6] = changes_by_left(T)[:3]
    J[3, 6] = 1.0
    of_clock = np.inf if timed is None else timed.covariance[0, 0] + _CLOCK_FLOOR_S**2
    weight, hills_rad = 1 / np.append(variance, of_clock), _by_hills(rows["roll"])
    floors = np.hypot(STANCE[:3], _aside_rad(T))
    halves = [(k, fits[name], float(floors[k])) for k, name in enumerate(("roll", "pitch", "yaw"))]
    straight = np.flatnonzero(_is_straight(travel, T))
    series = Series(2, rows["yaw"], travel.scene[straight], travel.stamp_ns[straight], float(floors[2]))
    return EdgeEvidence(
        edge, inverse(T), 0.0 if timed is None else float(timed.value[0]), (J.T * weight) @ J,
        np.zeros(7), _errors(edge, T, hills_rad), frames_used=len(travel.span_s), checks=_checks(edge, clock),
        diagnostics=_numbers(travel, fits, clock), notes=_notes(fits, timed),
        others=other_scenes(T, halves), parts=first_and_last(T, series),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Apart:
    """Azimuth of travel and yaw of a camera at a T_base_camera, less those of the base.

    Tracks confuse a turn with a shift aside, so that what one of the two is known to be sharpens the other.

    Args:
        azimuth, yaw: N [rad]; yaw 0 where the base's is unknown.
        variances, covariance: N of the azimuth, N of the yaw; N of both, 0 where the base's yaw is unknown.
        by_base: N 3, derivative of the base's yaw by scale, clock [s] and drift [rad/s].
    """

    azimuth: np.ndarray
    yaw: np.ndarray
    variances: tuple[np.ndarray, np.ndarray]
    covariance: np.ndarray
    by_base: np.ndarray


def _apart(travel: CameraTravel, T: np.ndarray) -> _Apart:
    R = T[:3, :3]
    direction, turn = travel.direction @ R.T, travel.turn @ R.T
    expected = _expected(travel, T, turn)
    off = np.arctan2(direction[:, 1], direction[:, 0]) - np.arctan2(expected[:, 1], expected[:, 0])
    known = _knows_yaw(travel)
    turned, by_clock = np.nan_to_num(travel.turned_rad), np.nan_to_num(travel.turned_by_clock_radps)
    # Of an azimuth, beside the direction of travel: other than directions these are nearly along x.
    both = np.copysign(1.0, direction[:, 0]) * ((travel.covariance[:, :3, 3:] @ R[1]) @ R[2])
    return _Apart(
        np.arctan2(np.sin(off), np.cos(off)), np.where(known, turn[:, 2] - turned, 0.0),
        (R[1] @ travel.covariance[:, 3:, 3:] @ R[1] + _LEAST_RAD**2, R[2] @ travel.covariance[:, :3, :3] @ R[2]),
        np.where(known, both, 0.0), np.stack([turned, -by_clock, travel.span_s], 1),
    )  # fmt: skip


def _rows(travel: CameraTravel, T: np.ndarray) -> dict[str, Rows]:
    """Regressions of the changes of T_base_camera: yaw and pitch by the way, roll and pitch by the axis of turns."""
    R = T[:3, :3]
    direction, turn = travel.direction @ R.T, travel.turn @ R.T
    of_turn = R @ travel.covariance[:, :3, :3] @ R.T
    bend, straight = _bends(travel), _is_straight(travel, T)
    by_way = turn / np.nan_to_num(travel.driven_m, nan=_WAY_M)[:, None]
    one, free, leaning = np.ones(len(turn)), np.array([np.inf]), np.array([np.inf, _LEAN_SIGMA_RAD])
    apart = _apart(travel, T)
    slope = apart.covariance / apart.variances[1]
    design = np.column_stack([one, by_way[:, 2], by_way[:, 0], slope[:, None] * apart.by_base])
    left = np.sqrt(apart.variances[0] - slope * apart.covariance)
    yaw = Rows(design, slope * apart.yaw - apart.azimuth, left, bend, _YAW_PRIORS, one)
    elevation = np.arctan2(direction[:, 2], np.hypot(direction[:, 0], direction[:, 1]))
    elevation *= np.copysign(1.0, direction[:, 0])
    of_direction = R @ travel.covariance[:, 3:, 3:] @ R.T
    pitch = Rows(one[:, None], elevation, _sigma(of_direction, 2), bend, free, one)
    # Errors of a camera's turns about two axes go together: the base's turn has neither.
    yawed = np.where(_knows_yaw(travel), np.nan_to_num(travel.turned_rad), turn[:, 2])
    turning = (np.abs(yawed) > _TURNING_RAD) & np.isfinite(travel.driven_m)
    aside_g = np.nan_to_num(travel.driven_m) * yawed / (travel.span_s**2 * _G_MPS2)
    bent = np.column_stack([yawed, yawed * aside_g])
    roll = Rows(bent, turn[:, 1] - _LEAN_RAD * bent[:, 1], _sigma(of_turn, 1), bend, leaning, one)
    by_axis = Rows(-yawed[:, None], turn[:, 0], _sigma(of_turn, 0), bend, free, one)
    ways = {"yaw": yaw.some(straight), "pitch": pitch.some(straight)}
    return ways | {"roll": roll.some(turning), "pitch_by_axis": by_axis.some(turning)}


def _sigma(covariance: np.ndarray, axis: int) -> np.ndarray:
    return np.sqrt(covariance[:, axis, axis] + _LEAST_RAD**2)


def _expected(travel: CameraTravel, T: np.ndarray, turn: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Way of the camera in axes of the base midway: the base's own, and the turn times the lever arm.

    A body that rolls moves a camera on its roof aside: on the real car .1 deg of roll over 3 m is .06 deg of travel.
    """
    way = np.where(
        np.isnan(travel.driven_m),
        np.copysign(_WAY_M, (travel.direction @ T[:3, :3].T)[:, 0]),
        travel.driven_m,
    )
    chord = way * np.sinc(turn[:, 2] / (2 * np.pi))
    across = 2 * np.sin(turn[:, 2] / 2)
    rolled = turn[:, 0] * (T[2, 3] - _ROLL_AXIS_M)
    # Of a yaw rate that changes evenly, the mean heading less the one midway between both images.
    begun = chord * travel.span_s * np.nan_to_num(travel.turned_by_clock_radps) / 12
    return np.stack([chord - across * T[1, 3], across * T[0, 3] - rolled - begun], 1)


def _is_straight(travel: CameraTravel, T: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Pairs that show the direction of travel: where nothing shows the way, hardly turning ones."""
    turned = (travel.turn @ T[:3, :3].T)[:, 2]
    return np.asarray(np.isfinite(travel.driven_m) | (np.abs(turned) < _MOST_TURN_RAD))


def _bends(travel: CameraTravel) -> Int64[np.ndarray, " N"]:
    """Block of each pair: within one stretch of road the car leans and slips alike."""
    rate = np.abs(np.nan_to_num(travel.driven_m, nan=3.0)) / travel.span_s
    gap_s = np.diff(travel.stamp_ns, prepend=travel.stamp_ns[:1]) * 1e-9
    new = np.diff(travel.drive, prepend=travel.drive[:1]) != 0
    way_m = np.where(new, _BEND_M, rate * np.clip(gap_s, 0.0, 2.0 * _BEND_M))
    return np.asarray(np.cumsum(way_m) // _BEND_M, np.int64)


def _combined(fits: dict[str, Regression | None]) -> tuple[np.ndarray, np.ndarray]:
    """Roll, pitch and yaw, and variances: pitch by both of its sources, wider if they differ."""
    found = {
        name: (0.0, np.inf) if f is None else (f.value[0], f.covariance[0, 0]) for name, f in fits.items()
    }
    both = np.array([found["pitch"], found["pitch_by_axis"]])
    weight = 1 / both[:, 1]
    pitch = (0.0, np.inf)
    if weight.sum() > 0:
        mean = weight @ both[:, 0] / weight.sum()
        pitch = mean, max(1.0, weight @ (both[:, 0] - mean) ** 2) / weight.sum()
    change = np.array([found["roll"], pitch, found["yaw"]])
    return change[:, 0], change[:, 1]


def _clock(travel: CameraTravel, T: np.ndarray) -> Regression | None:
    """Stamp of the camera less that of the base, scale of its turns less 1, and drift of the yaw rate.

    A camera that is late shows earlier turns: its turn less the base's is minus the delay times the yaw rate's change.
    """
    apart = _apart(travel, T)
    slope = apart.covariance / apart.variances[0]
    sigma = np.sqrt(apart.variances[1] - slope * apart.covariance + (0.2 * _LEAST_RAD) ** 2)
    design, priors = apart.by_base[:, [1, 0, 2]], np.array([_NO_CLOCK_S, _NO_SCALE, _DRIFT_SIGMA_RADPS])
    turned = Rows(
        design, apart.yaw - slope * apart.azimuth, sigma, _bends(travel), priors, np.ones(len(sigma))
    )
    return regress(turned.some(_knows_yaw(travel)))


def _knows_yaw(travel: CameraTravel) -> Bool[np.ndarray, " N"]:
    """Pairs over which the base's yaw is known."""
    return np.asarray(np.isfinite(travel.turned_rad) & np.isfinite(travel.turned_by_clock_radps))


def _checks(edge: Edge, clock: Regression | None) -> tuple[Check, ...]:
    """An image that is mirrored turns the other way."""
    if clock is None or 1 + clock.value[1] + 3 * np.sqrt(clock.covariance[1, 1]) > 0:
        return ()
    return (Check(because("mirrored", camera=edge.parent.name), "orientation", disproves=True),)


def _by_hills(roll: Rows) -> float:
    """One sigma of the roll by turns, from hills that each bend has of its own [rad]."""
    weight = roll.A[:, 0] / roll.sigma**2
    of_bends = np.bincount(roll.block, weight)
    return float(_HILL_RAD * np.linalg.norm(of_bends) / max(float(weight @ roll.A[:, 0]), 1e-9))


def _aside_rad(T: np.ndarray) -> Float[np.ndarray, " 3"]:
    """About axes of the base, as long as the sine of the angle between view and travel; each scene has its own."""
    return np.asarray(_ASIDE_RAD * np.cross(T[:3, 2], [1.0, 0.0, 0.0]))


def _errors(edge: Edge, T: np.ndarray, hills_rad: float) -> Mapping[str, np.ndarray]:
    """Biases by owner: the car's stance, the matching, the camera's intrinsics, hills within turns."""
    matching = np.diag([_ROLL_FLOOR_RAD, _FLOOR_RAD, _FLOOR_RAD, 0.0, 0.0, 0.0])
    aside = np.append(_aside_rad(T), np.zeros(3))[None]
    centre = Considered("centre", _CENTRE_RAD * np.eye(2, 6))
    hills = Considered("hills", hills_rad * np.eye(1, 6))
    return by_sensor([*of_stance_and(T, matching=matching, aside=aside), centre, hills], edge)


def _numbers(
    travel: CameraTravel, fits: dict[str, Regression | None], clock: Regression | None
) -> dict[str, float]:
    numbers = {"image_pairs": float(len(travel.span_s))}
    if clock is not None:
        scale, sigma = float(clock.value[1]), float(np.sqrt(clock.covariance[1, 1]))
        numbers |= {"focal_by_turns": scale, "focal_by_turns_sigma": sigma}
    by_way, by_axis = fits["pitch"], fits["pitch_by_axis"]
    if by_way is not None and by_axis is not None:
        numbers |= {"pitch_way_less_axis_deg": float(np.degrees(by_way.value[0] - by_axis.value[0]))}
    return numbers


def _notes(fits: dict[str, Regression | None], clock: Regression | None) -> tuple[str, ...]:
    shown = {"camera base, yaw": fits["yaw"], "camera base, roll": fits["roll"], "camera base, clock": clock}
    return (*(because(name) for name, fit in shown.items() if fit is None), because("camera base, shift"))
