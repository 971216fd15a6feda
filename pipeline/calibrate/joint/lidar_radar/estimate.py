"""Lidar-radar half of method `joint`: T_lidar_radar and the radar's time offset from a day of observations.

Unknowns that the day does not determine keep the prior. After the first solution, each unknown of the pose,
and the time offset, is fixed at the prior's value and sigma unless the day halved its variance. The others
are solved again, and their covariance includes the uncertainty of the fixed ones. Otherwise a weakly
determined unknown would follow any weak structure of the scene, by many sigmas of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.calibrate.joint.lidar_radar.elevation_errors import (
    beam_spacing,
    contradiction,
    doubted,
    elevation_spread,
    radar_tilt_axes,
    seen_low_of,
)
from pipeline.calibrate.joint.lidar_radar.normal_equations import (
    elevation_equations,
    height_equations,
    travel_equations,
)
from pipeline.calibrate.joint.lidar_radar.observability import (
    ObservabilityAnalysis,
    analyse_observability,
    diagnostics_of,
    notes_of,
    own_position,
)
from pipeline.calibrate.joint.lidar_radar.problem import DT, SCHEDULE, RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.search import (
    OtherOffsets,
    anneal,
    better_time_offset,
    comparison_cost,
    far_time_offset,
    finish,
    scan,
    time_offset_scatter_s,
)
from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.calibrate.numerics.frame_blocks import blocks_of, parts_of_day, scenes_of, with_parts
from pipeline.calibrate.numerics.nuisances import PartTurn, estimate_biases
from pipeline.calibrate.reasons import because
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.objective.radar.heights import displaced_heights
from pipeline.objective.radar.moving_clusters import moving_clusters
from pipeline.objective.radar.registration import registration_frames
from pipeline.objective.radar.travel import travel_directions
from pipeline.objective.stamp_gaps import constant_gap_s, gaps_s
from pipeline.rig.estimates import DayParts, PairEstimate, Prior, common_part
from pipeline.rig.se3 import change_between, change_jacobian
from schemas.observations import Observation

__all__ = ["contradicts_odometry", "estimate_lidar_radar", "turns_unmeasured"]

_FEWEST_FRAMES = 5
# Of a part from the whole day: the registration reaches a degree and a half.
_KNOCKS_RAD = tuple(np.radians([-5.0, -3.5, -2.0, 2.0, 3.5, 5.0]).tolist())
_YAW, _ANY_RAD = 2, np.radians(20.0)


def estimate_lidar_radar(
    observations: Sequence[Observation], prior: Prior, config: SolveConfig, rng: np.random.Generator
) -> PairEstimate:
    """Estimate T_lidar_radar and the radar's time offset (stamp_lidar = stamp_radar + dt).

    Args:
        observations: the day's frames.
        prior: start, and weak information. It loses weight if the data contradict it by many sigmas, and
            dominates where the data have little information.
        config: search range, sigma of the time offset, resampling.
        rng: selects detections and resamples.

    Raises:
        SolveError: too few frames with static detections and a lidar map.
    """
    problem, rejected = _problem(observations, prior, config, rng)
    count = problem.frames.count
    some = problem if count < SCHEDULE.many_frames else problem.of_frames(np.arange(0, count, 2))
    ends = [anneal(some, start) for start in scan(problem, config)]
    costs = [comparison_cost(problem, end) for end in ends]
    best = ends[int(np.argmin([c.mean() for c in costs]))]
    sources: tuple[PartTurn, ...] | None = None
    without_way = best
    if {"doppler", "static"} & set(config.terms):
        problem, without_way, sources = _with_way(problem, best, rng)
    analysis = analyse_observability(problem, without_way, config, rng)
    others = OtherOffsets(problem, analysis.state)
    better = better_time_offset(others)
    if better is not None:
        analysis = analyse_observability(problem, better, config, rng)
        others = OtherOffsets(problem, analysis.state)
    analysis = _with_sources(analysis, sources, without_way)
    block = blocks_of(problem.observations, config.bootstrap_blocks)
    analysis = _with_other_dips(others, analysis, block[problem.frames.frame])
    found = _conclude(analysis, rejected)
    own = own_position(problem, analysis.state, analysis.fixed, block)
    own |= far_time_offset(problem, analysis.state)
    found = with_parts(found, _parts(problem, analysis, config, rng))
    return replace(found, diagnostics=found.diagnostics | own)


def _problem(
    observations: Sequence[Observation], prior: Prior, config: SolveConfig, rng: np.random.Generator
) -> tuple[RadarProblem, dict[str, int]]:
    """The problem from usable frames, and counts of rejected frames by reason."""
    given, wrong = len(observations), contradicts_odometry(observations)
    observations = [o for o, is_wrong in zip(observations, wrong, strict=True) if not is_wrong]
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
        raise SolveError(because("few static", needed=_FEWEST_FRAMES, used=frames.count))
    gap_s = constant_gap_s(gaps_s(observations, "radar"))
    movers = moving_clusters(observations, with_boxes=False)
    problem = RadarProblem(
        observations,
        replace(frames, stamp_gap_s=frames.stamp_gap_s - gap_s),
        replace(movers, stamp_gap_s=movers.stamp_gap_s - gap_s),
        prior,
        config.time_offset_sigma_s,
        beam_spacing(observations),
        elevation_spread(frames),
        config.terms,
        gap_s,
    )
    return problem, rejected


def _parts(
    problem: RadarProblem, analysis: ObservabilityAnalysis, config: SolveConfig, rng: np.random.Generator
) -> DayParts | None:
    """Rotations of the first and the last part of the day, compared in the axes that the day determines."""
    frames, start = problem.frames.frame, analysis.state
    about = replace(problem, prior=replace(problem.prior, T_lidar_radar=start.T_lidar_radar))
    fixed = analysis.fixed | np.isin(np.arange(len(analysis.fixed)), (3, 4, 5))
    turns = np.flatnonzero(~fixed[:3])
    if not len(turns):
        return None
    # What all frames of a day err by alike comes of where it was driven: the parts were driven elsewhere.
    of_scenes = analysis.of_scenes[:3, :3]

    def solve(rows: np.ndarray) -> tuple[RadarState, np.ndarray, np.ndarray]:
        part = about.of_frames(rows)
        state, linear = finish(part, _start_of_part(part, start, len(fixed)), fixed)
        H, g, P = (a[..., ~fixed] for a in (linear.information, linear.g, linear.prior_information))
        block = blocks_of(part.observations, config.bootstrap_blocks)
        found = bootstrap_covariance(H[:, ~fixed], g, P[~fixed], block, rng)  # turns come first
        spread = np.eye(3) * _ANY_RAD**2
        spread[np.ix_(turns, turns)] = found[: len(turns), : len(turns)] + of_scenes[np.ix_(turns, turns)]
        return state, state.T_lidar_radar, spread

    stamps = [problem.observations[k].stamp_ns for k in frames]
    gradient, tested = analysis.linear.g[frames][:, turns], tuple(turns.tolist())
    scene = scenes_of([problem.observations[k] for k in frames])
    return parts_of_day(
        gradient, stamps, solve, lambda state: -comparison_cost(problem, state), tested, scene
    )


def _start_of_part(part: RadarProblem, start: RadarState, unknowns: int) -> RadarState:
    """Start for a part: the day's solution, or a yaw rotation of it that fits better (after a large knock)."""
    turned = [start.moved(angle * (np.arange(unknowns) == _YAW)) for angle in (0.0, *_KNOCKS_RAD)]
    return min(turned, key=lambda state: float(comparison_cost(part, state).sum()))


def _with_way(
    problem: RadarProblem, state: RadarState, rng: np.random.Generator
) -> tuple[RadarProblem, RadarState, tuple[PartTurn, ...]]:
    """The problem with direction of travel and displaced heights, the solution without them, and the pitch of each.

    Pitches and the radar's sigmas are computed at the solution without them. Otherwise, a wrong direction of
    travel would also move the pose, and the registration would treat the discrepancy as noise.
    """
    state, linear = finish(problem, state, sharpen=True)
    about = problem.observations, state.T_lidar_radar, state.dt_s - problem.constant_gap_s
    # Elevations move z with pitch: a radar .1 m too high sees all .4 deg too high at 15 m. z is the prior's knowledge.
    level = state.T_lidar_radar.copy()
    level[2, 3] = problem.prior.T_lidar_radar[2, 3]
    travel = travel_directions(*about) if "doppler" in problem.terms else None
    has_static = "static" in problem.terms
    heights = displaced_heights(about[0], level, about[2], rng.spawn(1)[0]) if has_static else None
    seeing = replace(problem, travel=travel, heights=heights, seen_low=seen_low_of(travel, heights))
    asked = (
        elevation_equations(problem, state, linear.registration),
        travel_equations(seeing, state),
        height_equations(seeing, state),
    )
    sources = [seeing.seen_low.expected(w) for w in asked if w is not None]
    doubt_rad = doubted(sources)
    wider = tuple(w.wider(doubt_rad.get(w.name, 0.0)) for w in sources)
    return replace(seeing, doubt_rad=doubt_rad), replace(state, seen_low=seeing.seen_low.mean), wider


def _with_sources(
    analysis: ObservabilityAnalysis, sources: tuple[PartTurn, ...] | None, asked_at: RadarState
) -> ObservabilityAnalysis:
    """The analysis with an increased variance of pitch if its sources contradict each other."""
    if sources is None:
        return analysis
    axes = radar_tilt_axes(analysis.state.T_lidar_radar)
    turn = change_between(asked_at.T_lidar_radar, analysis.state.T_lidar_radar)[:2]
    moved = float(turn @ axes[:, 1])
    sources = tuple(replace(w, offset_rad=w.offset_rad - moved) for w in sources)
    covariance, common, disagreement = analysis.covariance, analysis.common, contradiction(sources)
    if disagreement is not None and not analysis.fixed[int(np.argmax(np.abs(axes[:, 1])))]:
        # The record's axes are the lidar's: only the radar's own pitch gets less sure.
        wider = np.eye(len(covariance))
        wider[:2, :2] += (disagreement.factor - 1) * np.outer(axes[:, 1], axes[:, 1])
        covariance, common = (wider @ part @ wider for part in (covariance, common))
    return replace(analysis, sources=sources, covariance=covariance, common=common)


def _with_other_dips(
    others: OtherOffsets, analysis: ObservabilityAnalysis, block: Int[np.ndarray, " F"]
) -> ObservabilityAnalysis:
    """The analysis with the variance over blocks of frames, and the weight of the time offset against the expected one.

    The pose stays: where dips are everywhere, it does not depend on them.
    """
    if analysis.fixed[DT]:
        return analysis
    scatter_s = time_offset_scatter_s(others, block, np.random.default_rng(0))
    weight = 1 / (1 + (scatter_s / analysis.problem.dt_sigma_s) ** 2)
    covariance = analysis.covariance.copy()
    covariance[DT, DT] += weight * scatter_s**2
    return replace(analysis, covariance=covariance, dt_weight=weight)


def _conclude(analysis: ObservabilityAnalysis, rejected: dict[str, int]) -> PairEstimate:
    problem, state, fixed = analysis.problem, analysis.state, analysis.fixed
    covariance = analysis.covariance[:6, :6]
    # The record's covariance is of a left perturbation: a turn about the lidar carries the radar along.
    J = np.linalg.inv(change_jacobian(state.T_lidar_radar))
    return PairEstimate(
        "lidar_radar",
        state.T_lidar_radar,
        J @ covariance @ J.T,
        analysis.observability[:6],
        ~fixed[:6],
        problem.frames.count,
        {reason: count for reason, count in rejected.items() if count},
        analysis.dt_weight * state.dt_s - problem.constant_gap_s,
        float(np.sqrt(analysis.covariance[DT, DT])),
        diagnostics_of(analysis),
        notes_of(analysis),
        common_part(J @ analysis.common[:6, :6] @ J.T, J @ covariance @ J.T),
        time_offset_prior_s=-problem.constant_gap_s,
        **estimate_biases(analysis.considered, J),
    )


# --------------------------------------------------------------------------------------------------
# Frames whose radar velocity is wrong: it decides which detections are static, and where points are a moment later.
#
# A radar's own velocity is that on which most detections agree. Beside a convoy that is the convoy's: on a
# simulated highway 18 of 67 frames were 3 to 9 m/s off, their moving vehicles taken for static ones, and moved
# x by 0.2 to 1.5 m at a sigma of 0.09. The car's odometry contradicts such frames, and so does a direction of
# travel that never changes.

_FEWEST_MOVING = 5
_MOVING_MPS = 3.0
# Of a radar 3 m ahead of the axle: 6 deg/s, 0.1 deg in 20 ms; Doppler's own noise is 0.05 m/s.
_SIDEWAYS_MPS = 0.3
# What radar and odometry may differ by: on 15 of 16 simulated days no frame was beyond 0.4 m/s, except for real
# outliers.
_DIFFERENT_MPS = 0.5
_DIFFERENT_SHARE = 0.03  # of the speed
_MOST = 0.5  # of the frames: where more contradict it, the odometry is wrong
_LEVER_M = (-1.0, 6.0)  # of a radar ahead of the rear axle
_PASSES = 8  # of fitting lever arm and mounting in turn


def turns_unmeasured(observations: Sequence[Observation]) -> Bool[np.ndarray, " F"]:
    """Frames taken in a turn without a measured yaw rate.

    A radar ahead of the rear axle moves sideways in a turn, by yaw rate times lever arm. Without the yaw rate
    neither the lidar's sweep nor the gap between the stamps is corrected: on a real day one such turn of
    eleven frames moved yaw by 0.25 deg, x by 15 cm and dt by 10 ms against all other streets.
    """
    unmeasured = np.array([o.ego_yaw_rate_radps is None for o in observations], bool)
    return unmeasured & (np.abs(_travel(observations)[:, 1]) > _SIDEWAYS_MPS)


def contradicts_odometry(observations: Sequence[Observation]) -> Bool[np.ndarray, " F"]:
    """Frames whose radar velocity is impossible on this car, by its speed or its yaw rate.

    Sideways the radar moves by yaw rate times a lever arm, the same all day; an odometer may count a constant
    share too much. What the car does not log cannot be contradicted, and an odometry that most frames
    contradict is itself wrong.
    """
    travel = _travel(observations)
    radar_mps = np.hypot(travel[:, 0], travel[:, 1])
    odometer_mps = np.abs([np.nan if o.ego_speed_mps is None else o.ego_speed_mps for o in observations])
    both = (radar_mps > _MOVING_MPS) & (odometer_mps > _MOVING_MPS)
    wrong = np.array([o.ego_yaw_rate_radps is not None for o in observations], bool)
    wrong &= np.abs(travel[:, 1]) > _DIFFERENT_MPS
    if both.any():
        scale = float(np.median(radar_mps[both] / odometer_mps[both]))
        apart_mps = np.abs(radar_mps - scale * odometer_mps)
        wrong |= apart_mps > _DIFFERENT_MPS + _DIFFERENT_SHARE * odometer_mps
    return wrong if wrong.sum() <= _MOST * len(wrong) else np.zeros_like(wrong)


def _travel(observations: Sequence[Observation]) -> Float[np.ndarray, "F 2"]:
    """Velocities along the day's direction of travel, and across it beyond the effect of the measured turn.

    NaN for a frame without velocity, and for all if too few frames move to determine the direction.
    """
    velocity = np.array(
        [
            np.full(2, np.nan) if o.radar_velocity_mps is None else o.radar_velocity_mps[:2]
            for o in observations
        ]
    ).reshape(-1, 2)
    turn = np.array([o.ego_yaw_rate_radps or 0.0 for o in observations])
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > _MOVING_MPS
    if moving.sum() < _FEWEST_MOVING:
        return np.full_like(velocity, np.nan)
    # How the radar is mounted; the mean of all ways first, for a radar that looks back has angles about +-180 deg.
    ahead = _turned_by(velocity, -np.arctan2(*velocity[moving].sum(0)[::-1]))
    angle, sharpness = np.arctan2(ahead[moving, 1], ahead[moving, 0]), turn[moving] / speed[moving]
    mounted, lever_m = float(np.median(angle)), 0.0
    for _ in range(_PASSES):
        lever_m = _lever_m(angle - mounted, sharpness)
        mounted = float(np.median(angle - lever_m * sharpness))
    ahead = _turned_by(ahead, -mounted)
    return ahead - np.stack([np.zeros_like(turn), lever_m * turn], 1)


def _turned_by(velocity: np.ndarray, angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return velocity @ np.array([[c, s], [-s, c]])


def _lever_m(angle_rad: np.ndarray, sharpness_radpm: np.ndarray) -> float:
    """Lever arm by least absolute deviations: the median of the frames' own, weighted by how sharply they turn."""
    weight = np.abs(sharpness_radpm)
    use = weight > 0
    if not use.any():
        return 0.0
    own = angle_rad[use] / sharpness_radpm[use]
    order = np.argsort(own)
    share = np.cumsum(weight[use][order])
    return float(np.clip(own[order][np.searchsorted(share, 0.5 * share[-1])], *_LEVER_M))
