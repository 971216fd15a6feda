"""Edge radar-base: mounting of a radar on the car, from its own velocity and the car's direction of travel.

In straight driving, the direction of travel is the base's x axis, and its azimuth in radar axes is yaw. In
turns, a radar ahead of the rear axle moves sideways by the yaw rate times its lever arm. This and the slip of
the axle have one common slope over curvature. No log separates them, so x has no information. Pitch needs
elevations, but least squares on them is biased towards their mean. The velocities of
`objective/radar/travel`, corrected by a lidar with the same view, determine pitch; a radar without a view in
common with a lidar has no pitch. Roll and position do not affect the direction of travel. Changes of speed
determine the clock. The motion must come from sources other than this radar.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64

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
from pipeline.calibrate.numerics.nuisances import by_sensor
from pipeline.calibrate.reasons import because
from pipeline.calibrate.verify.motion_sources import compared_sources
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import DopplerMotion, EgoMotion
from pipeline.objective.radar.travel import TravelDirections, travel_directions
from pipeline.rig.estimates import Check, EdgeEvidence
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from schemas.observations import Observation

__all__ = ["Stamps", "estimate_radar_base", "solve"]

_LEAST_SPEED_MPS = 4.0  # slower, noise of 0.05 m/s is a degree
_LEVER_SIGMA_M = (
    1.5  # by which the lever arm, the base's place before the axle, and slip differ from the prior
)
_SCALE_SIGMA = 0.02  # of an odometer
_LEAST_AZIMUTH_RAD = np.radians(0.1)
_LEAST_SPEED_SIGMA_MPS = 0.05
_BEND_M = 50.0  # in one bend a car slips the same way
_LONGEST_S = 2.0  # between moments from which accelerations are computed
_YAW_FLOOR_RAD = np.radians(0.02)  # errors of 8 tuning days were 0.018 deg RMS
_CLOCK_FLOOR_S = 0.004  # as scenes scatter; of no clock less is promised
_RADARS_CLOCK_S = 0.02  # of a base whose speed other radars show: each has a clock of its own
_NO_CLOCK_S = 1.0  # a clock that is not known to half of this is not known
_PASSES = 3
_FEWEST_DIRECTIONS = 8  # scans whose elevations a lidar mends: fewer show no pitch


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times of moments and of a radar's scans, each by its own clock, and the drives."""

    moment_ns: np.ndarray  # F
    scan_ns: np.ndarray  # F
    drive: np.ndarray  # F


def solve(edge: Edge, sources: DaySources) -> tuple[EdgeEvidence, int]:
    """Evidence of a day, and its number of moments; raises SolveError if there are too few."""
    name = edge.parent.name
    rows = sources.rows({"radar": name})
    sources.on_base(name)
    radar = sources.doppler(name, rows) if rows else None
    if radar is None:
        raise SolveError(because("silent", sensor=name, what="scan"), "silent_sensor")
    wrong = sources.backwards
    if name in wrong:
        return _turned_round(edge, radar), len(rows)
    of_rows = ([o.stamp_ns for o in rows], [o.radar_stamp_ns for o in rows], [o.drive for o in rows])
    stamps = Stamps(*(np.array(column) for column in of_rows))
    ego = sources.ego_at(rows, without=name)
    if sources.prior.is_base_loose and not np.isfinite(ego.velocity_mps).any():
        ego = sources.ego_by_cameras(radar, rows)
        stamps = replace(stamps, drive=np.arange(len(rows)))  # a drive each: no change of speed, no clock
    if not np.isfinite(ego.velocity_mps).any():
        reason = "no motion, backwards" if wrong else "no motion"
        raise SolveError(because(reason, sensor=name, others=", ".join(wrong)))
    # The pair lidar-radar has these elevations already; a frame by travel adds nothing to them.
    directions = None if sources.prior.is_base_loose else _directions(name, rows, sources)
    timed = sources.odometry_mps(rows)
    found = estimate_radar_base(edge, radar, ego, stamps, Scenes.of(rows), directions, timed)
    compared = compared_sources(rows, radar.T_base_radar)
    return replace(found, checks=(*found.checks, *compared.wrong)), len(rows)


def estimate_radar_base(
    edge: Edge,
    radar: DopplerMotion,
    ego: EgoMotion,
    stamps: Stamps,
    scenes: Scenes,
    directions: TravelDirections | None = None,
    timed_mps: Float[np.ndarray, " F"] | None = None,
) -> EdgeEvidence:
    """Evidence of a day on T_radar_base and on the base's clock.

    Args:
        radar: its Doppler, and the start, whose rotation does not contribute to the information.
        ego: motion of the base at the same moments, from other sources.
        directions: velocities corrected by a lidar's elevations; None for a radar without a view in common
            with a lidar.
        timed_mps: speed by odometry, whose clock is the base's; None without: that of `ego` mixes clocks of radars.
    """
    T, speed_mps = radar.T_base_radar, ego.velocity_mps[:, 0] if timed_mps is None else timed_mps
    for _ in range(_PASSES):
        turns, clock = _by_doppler(radar, T, ego, stamps, speed_mps)
        yaw, pitch = regress(turns), None if directions is None else _pitch(directions, T, scenes)
        turn = np.array([0.0, 0.0 if pitch is None else pitch.value[0], 0.0 if yaw is None else yaw.value[0]])
        T = from_rotation_translation(exp_so3(turn) @ T[:3, :3], T[:3, 3])
    variance = np.array([np.inf if fit is None else fit.covariance[0, 0] for fit in (pitch, yaw, clock)])
    variance[2] += (_RADARS_CLOCK_S if timed_mps is None else _CLOCK_FLOOR_S) ** 2
    J = np.zeros((3, 7))
    J[:2, :6] = changes_by_left(T)[[1, 2]]
    J[2, 6] = 1.0
    moving = np.flatnonzero(_moving(radar, ego))
    day = Series(2, turns, scenes.scene[moving], stamps.moment_ns[moving], float(STANCE[2]))
    halves = [(1, pitch, float(STANCE[1])), (2, yaw, float(STANCE[2]))]
    return EdgeEvidence(
        edge, inverse(T), 0.0 if clock is None else float(clock.value[0]), (J.T / variance) @ J, np.zeros(7),
        _errors(edge, T, 0.0 if directions is None else directions.bias_rad()),
        frames_used=len(moving), diagnostics=_numbers(yaw, len(moving)), notes=_notes(yaw, pitch, clock),
        others=other_scenes(T, halves), parts=first_and_last(T, day),
    )  # fmt: skip


def _moving(radar: DopplerMotion, ego: EgoMotion) -> np.ndarray:
    known = np.isfinite(radar.velocity_mps).all(1) & np.isfinite(ego.velocity_mps).all(1)
    return np.asarray(known & (np.abs(np.nan_to_num(ego.velocity_mps[:, 0])) > _LEAST_SPEED_MPS))


def _by_doppler(
    radar: DopplerMotion, T: np.ndarray, ego: EgoMotion, stamps: Stamps, speed_mps: np.ndarray
) -> tuple[Rows, Regression | None]:
    """Rows of the change of yaw, and the clock: stamp of the radar minus that of the base, whose speed is given."""
    use = _moving(radar, ego)
    R, ways = T[:2, :3], np.copysign(1.0, ego.velocity_mps[use, :1])
    seen = radar.velocity_mps[use] @ R.T
    (vx, vy), turn = ego.velocity_mps[use].T, ego.yaw_rate_radps[use]
    expected = np.stack([vx - turn * T[1, 3], vy + turn * T[0, 3]], 1)
    speed = np.hypot(speed_mps[use] - turn * T[1, 3], expected[:, 1])
    off = np.arctan2(*(seen * ways).T[::-1]) - np.arctan2(*(expected * ways).T[::-1])
    covariance = R @ radar.covariance[use] @ R.T
    aside = np.sqrt(covariance[:, 1, 1] + ego.covariance[use, 1, 1]) / np.hypot(*expected.T)
    sigma = np.hypot(aside, _LEAST_AZIMUTH_RAD)
    bend = _bends(ego, stamps)[use]
    turning = np.stack([np.ones(len(off)), turn / vx], 1)
    lever = np.array([np.inf, _LEVER_SIGMA_M])
    yaw = Rows(turning, -np.arctan2(np.sin(off), np.cos(off)), sigma, bend, lever, turning[:, 0])
    faster, late_s = _accelerations(speed_mps, stamps)[use], (stamps.scan_ns - stamps.moment_ns)[use] * 1e-9
    apart = np.hypot(*seen.T) - speed - faster * ways[:, 0] * late_s
    sigma = np.sqrt(covariance[:, 0, 0] + _LEAST_SPEED_SIGMA_MPS**2)
    design = np.stack([-faster * ways[:, 0], speed], 1)
    told = np.isfinite(faster) & np.isfinite(speed)
    prior = np.array([_NO_CLOCK_S, _SCALE_SIGMA])
    clock = regress(Rows(design, apart, sigma, bend, prior, turning[:, 0]).some(told))
    return yaw, None if clock is None or clock.covariance[0, 0] > (_NO_CLOCK_S / 2) ** 2 else clock


def _pitch(directions: TravelDirections, T: np.ndarray, scenes: Scenes) -> Regression | None:
    """Change of pitch that makes the velocities level in the base."""
    v = directions.velocity_mps @ T[:3, :3].T
    elevation = np.arctan2(v[:, 2], np.hypot(v[:, 0], v[:, 1])) * np.copysign(1.0, v[:, 0])
    sigma, block = np.hypot(directions.sigma_rad, _LEAST_AZIMUTH_RAD), scenes.block[directions.frame]
    one = np.ones(len(v))
    return regress(Rows(one[:, None], elevation, sigma, block, np.array([np.inf]), one))


def _bends(ego: EgoMotion, stamps: Stamps) -> Int64[np.ndarray, " F"]:
    """Block of each moment, by the distance driven."""
    gap_s = np.diff(stamps.moment_ns, prepend=stamps.moment_ns[:1]) * 1e-9
    way_m = np.abs(np.nan_to_num(ego.velocity_mps[:, 0])) * np.clip(gap_s, 0.0, _LONGEST_S)
    return np.asarray(np.cumsum(way_m) // _BEND_M, np.int64)


def _accelerations(speed_mps: Float[np.ndarray, " F"], stamps: Stamps) -> Float[np.ndarray, " F"]:
    """Forward acceleration of each moment from its neighbours; NaN at ends of drives and across gaps."""
    found = np.full(len(stamps.drive), np.nan)
    span_s = (stamps.moment_ns[2:] - stamps.moment_ns[:-2]) * 1e-9
    near = (stamps.drive[2:] == stamps.drive[:-2]) & (span_s > 0) & (span_s < _LONGEST_S)
    change = speed_mps[2:] - speed_mps[:-2]
    found[1:-1] = np.where(near, change / np.where(near, span_s, 1.0), np.nan)
    return found


def _errors(edge: Edge, T: np.ndarray, pitch_rad: float) -> Mapping[str, np.ndarray]:
    """Biases by owner: the car's stance, the matching, and detections measured too low."""
    of_changes = {"matching": _YAW_FLOOR_RAD * np.eye(6)[[2]], "seen_low": pitch_rad * np.eye(6)[[1]]}
    return by_sensor(of_stance_and(T, **of_changes), edge)


def _numbers(yaw: Regression | None, moments: int) -> dict[str, float]:
    lever = {} if yaw is None else {"lever_less_prior_m": float(-yaw.value[1])}
    return {"moments": float(moments)} | lever


def _notes(yaw: Regression | None, pitch: Regression | None, clock: Regression | None) -> tuple[str, ...]:
    shown = {"radar base, yaw": yaw, "radar base, pitch": pitch, "radar base, clock": clock}
    return (*(because(name) for name, fit in shown.items() if fit is None), because("radar base, rest"))


def _directions(radar: str, rows: Sequence[Observation], sources: DaySources) -> TravelDirections | None:
    """Velocities that a lidar's elevations mend, of the lidar that most scans share their view with."""
    place = {o.frame_index: k for k, o in enumerate(rows)}
    found: list[TravelDirections] = []
    for lidar in sources.lidars:
        T = sources.prior.between(lidar, radar)
        both = [] if T is None else sources.rows({"lidar": lidar, "radar": radar})
        both = [o for o in both if o.frame_index in place]
        if T is not None and both:
            seen = travel_directions(both, T, 0.0)
            at = np.array([place[both[k].frame_index] for k in seen.frame], np.int64)
            found.append(replace(seen, frame=at))
    best = max(found, key=lambda seen: seen.count, default=None)
    return None if best is None or best.count < _FEWEST_DIRECTIONS else best


def _turned_round(edge: Edge, radar: DopplerMotion) -> EdgeEvidence:
    """A radar by whose Doppler the car drives backwards, at its prior."""
    nothing, moments = np.zeros((7, 7)), int(np.isfinite(radar.velocity_mps).all(1).sum())
    return EdgeEvidence(
        edge, inverse(radar.T_base_radar), 0.0, nothing, nothing[0], frames_used=moments,
        checks=(Check(because("radar backwards", sensor=radar.name), "doppler"),),
    )  # fmt: skip
