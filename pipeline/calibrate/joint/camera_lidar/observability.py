"""What of camera-lidar a day determines: tz and the clock by their profiles, the rest by ascent, and how surely.

A degree of freedom that the day does not determine is held at the prior and the others are solved again; their
covariance includes what the prior leaves open in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.heading_bias import motion_biases
from pipeline.calibrate.joint.camera_lidar.optical_axis import TZ, Profile, profile_tz, with_tz
from pipeline.calibrate.joint.camera_lidar.refine import (
    FOCAL_SIGMA,
    AlignmentState,
    climb,
    derivatives,
    scales,
    weighted,
)
from pipeline.calibrate.joint.camera_lidar.time_offset import (
    DT,
    FOCAL,
    ClockProfile,
    profile_clock,
    s_per_metre,
)
from pipeline.calibrate.numerics.covariance import OBSERVABLE, held_covariance, response
from pipeline.calibrate.numerics.frame_blocks import bootstrap_blocks
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.changes import change_jacobian
from pipeline.objective.camera_lidar.score import KernelSettings, Terms

__all__ = ["IS_TZ", "Day", "Found", "clock_variance", "determined", "measured"]

# What no resampling shows: mask dilation, focal length off by 0.1-0.5 %, rolling shutter
# (evidence/method.md, section 4); y as simulated days of seeds 110 to 145 show it.
_BIAS_FLOOR = np.array([np.radians(0.03)] * 3 + [0.01, 0.006, 0.01])
_TIME_OFFSET_FLOOR_S = 0.004
_CLOCK_POINTS = 9000  # of edges, and of markings: the clock's profile is sharp
IS_TZ, _IS_DT, _FOCAL_HELD = (np.arange(8) == k for k in (TZ, DT, FOCAL))


@dataclass(frozen=True, eq=False)
class Day:
    """What every solution of one day shares."""

    terms: Terms
    prior: Prior
    config: SolveConfig
    drives: list[int]
    seed: int  # of the bootstrap: solutions compare on the same resampled days
    tz_variance: float  # [m2]
    heading_sigma_rad: float
    sweep_s_per_rad: float


@dataclass(frozen=True, eq=False)
class Found:
    """A solution: what of it the day determined, and how surely (chart of `AlignmentState.changed`)."""

    prior: Prior  # with the tz that was found
    state: AlignmentState
    level: KernelSettings
    held: np.ndarray  # 8, bool
    covariance: np.ndarray  # 8 8
    observability: np.ndarray  # 6
    profile: Profile


def determined(day: Day, state: AlignmentState, level: KernelSettings, rng: np.random.Generator) -> Found:
    """Fix tz by its profile, then solve again with what the day cannot determine held at the prior.

    Left free, such a degree of freedom wanders as far as its prior lets it and drags others along: lane lines
    pull tz, and with it dt, by decimetres. To hold one can leave another undetermined, whose optimum follows it.
    """
    at_own_tz = replace(day, prior=with_tz(day.prior, float(state.T_camera_lidar[2, 3])))
    follow = response(_curvature(day, state, level), IS_TZ, np.zeros(8, bool))[:, 0]
    profile = profile_tz(day.terms, state, level, day.prior, day.config, follow)
    clock = _timed(at_own_tz, state, level, rng)
    state = clock.state
    level = weighted(day.terms, state, day.terms.fitted(state.alone, level, rng))
    follow = response(_curvature(day, state, level), IS_TZ, _FOCAL_HELD)[:, 0]
    before = float(day.prior.T_camera_lidar[2, 3]), day.prior.translation_sigma_m
    tz_m, variance = profile.with_prior(*before)
    seen = 1 - variance / before[1] ** 2
    if seen < OBSERVABLE:
        tz_m, variance = before[0], before[1] ** 2
    day = replace(day, prior=with_tz(day.prior, tz_m), tz_variance=variance)
    if tz_m != state.T_camera_lidar[2, 3]:
        state = state.stepped(follow * (tz_m - state.T_camera_lidar[2, 3]))
        clock = _timed(day, state, level, rng)
    state, held, observability = clock.state, IS_TZ, np.ones(6)
    while True:
        # The clock stays where its profile has it: free together with the focal length, it would wander off again.
        fixed = held | _IS_DT
        state = climb(day.terms, state, level, day.prior, day.config, steps=2, held=fixed)
        level = weighted(day.terms, state, day.terms.fitted(state.alone, level, rng))
        state = climb(day.terms, state, level, day.prior, day.config, steps=3, held=fixed)
        covariance, shrunk = measured(day, state, level, held)
        observability = np.where(held[:6], observability, shrunk)
        held_too = held | np.append(observability < OBSERVABLE, [False, False])
        if held_too.sum() == held.sum():
            break
        held = held_too
    covariance[DT, DT] = clock_variance(day, state, level, clock)
    observability[TZ] = max(seen, 0.0)
    return Found(day.prior, state, level, held, covariance, observability, profile)


def _timed(day: Day, state: AlignmentState, level: KernelSettings, rng: np.random.Generator) -> ClockProfile:
    """The clock's profile, by some of the points."""
    some = day.terms.at_most(_CLOCK_POINTS, rng)
    return profile_clock(some, state, level, day.prior, day.config, IS_TZ)


def clock_variance(day: Day, state: AlignmentState, level: KernelSettings, clock: ClockProfile) -> float:
    """Of the profile, its floor, and what tz and the focal length leave open [s2]; at most the prior's."""
    of_tz = s_per_metre(day.terms, state) ** 2 * day.tz_variance
    of_focal = response(_curvature(day, state, level), _FOCAL_HELD, IS_TZ)[DT, 0] * FOCAL_SIGMA
    day_variance = clock.variance_s2 + _TIME_OFFSET_FLOOR_S**2 + of_tz + of_focal**2
    return 1 / (1 / day_variance + 1 / day.config.time_offset_sigma_s**2)


def measured(
    day: Day, state: AlignmentState, level: KernelSettings, held: Bool[np.ndarray, " 8"]
) -> tuple[Float[np.ndarray, "8 8"], Float[np.ndarray, " 6"]]:
    """Covariance of a solution and observability; what is held has its own variance, and the others follow it."""
    terms, prior_variance = day.terms, _prior_variance(day)
    scale, curvature = scales(terms, level), _curvature(day, state, level)
    gradient = derivatives(terms, state, level, scale)[0] / scale
    # After `weighted`, the scatter of the frames' gradients is the curvature, without its roughness
    # (Bartlett's identity).
    information = gradient[:, :, None] * gradient[:, None, :]
    block = bootstrap_blocks(np.array(day.drives), day.config.bootstrap_blocks)
    covariance = held_covariance(
        information,
        -gradient,
        prior_variance,
        curvature,
        held,
        block,
        np.random.default_rng(day.seed),
    )
    floor = np.where(held, 0.0, np.append(_BIAS_FLOOR, [_TIME_OFFSET_FLOOR_S, 0.0]))
    motion = motion_biases(terms, state, level, curvature, held, day.heading_sigma_rad, day.sweep_s_per_rad)
    covariance = covariance + np.diag(floor**2) + motion.T @ motion
    return covariance, np.clip(1 - np.diag(covariance) / prior_variance, 0.0, 1.0)[:6]


def _prior_variance(day: Day) -> Float[np.ndarray, " 8"]:
    """Of every unknown before the frames' gradients are asked: of tz what its profile left."""
    rotation, translation = day.prior.rotation_sigma_rad, day.prior.translation_sigma_m
    sigma = np.array([rotation] * 3 + [translation] * 3 + [day.config.time_offset_sigma_s, FOCAL_SIGMA])
    return np.where(IS_TZ, day.tz_variance, sigma**2)


def _curvature(day: Day, state: AlignmentState, level: KernelSettings) -> Float[np.ndarray, "8 8"]:
    """Curvature of the cost without its roughness, in the chart of `changed`: Gauss-Newton, from the points' slopes.

    For ratios only. Moving tz on real logs moves dt by -0.04 s/m: this says -0.03, response surfaces +0.1 to -0.1.
    """
    _, information = day.terms.gradient(state.alone, level)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    return to_left.T @ information.sum(0) @ to_left + np.diag(1 / _prior_variance(day))
