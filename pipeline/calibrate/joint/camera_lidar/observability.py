"""Observability analysis of camera-lidar: the degrees of freedom that the day determines, and their covariance.

tz and the time offset are determined by their profiles, the others by local refinement. A degree of freedom
that the day does not determine is fixed at the prior, and the others are solved again; their covariance
includes its prior uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.borders import along_paint, border_errors
from pipeline.calibrate.joint.camera_lidar.profiles import (
    DT,
    FOCAL,
    TZ,
    TimeOffsetProfile,
    TzProfile,
    left_out_in_time,
    profile_time_offset,
    profile_tz,
    with_tz,
)
from pipeline.calibrate.joint.camera_lidar.refine import (
    SCHEDULE,
    AlignmentState,
    Scored,
    derivatives,
    refine,
    scales,
    weighted,
)
from pipeline.calibrate.numerics.covariance import (
    OBSERVABLE,
    bootstrap_covariance,
    covariance_with_fixed,
    response,
)
from pipeline.calibrate.numerics.frame_blocks import SCENE_DEGREES, Scenes, parts_of_day
from pipeline.calibrate.numerics.nuisances import (
    CAMERA_LIDAR_BIAS,
    CAMERA_LIDAR_DT_FLOOR_S,
    FOCAL_SIGMA,
    Considered,
    considered_covariance,
)
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.estimates import DayParts, Prior, prior_share
from pipeline.rig.se3 import change_jacobian
from schemas.observations import Observation

__all__ = [
    "IS_TZ",
    "CameraLidarProblem",
    "ObservabilityAnalysis",
    "along_the_way",
    "analyse_observability",
    "day_covariance",
    "parts_of_alignment",
    "time_offset_variance",
]

# Of what is expected of the time offset: edges beyond leave sight at its ends and are not asked. On 40 days of ten
# rigs (seeds that earlier versions were tuned on) 1 was as good as 2; further out few edges of a fast drive are left.
_REACH_SIGMAS = 2.0
IS_TZ, _IS_DT, _IS_FOCAL = (np.arange(8) == k for k in (TZ, DT, FOCAL))


@dataclass(frozen=True, eq=False)
class CameraLidarProblem:
    """Data and settings common to all solutions of one day."""

    terms: Terms
    prior: Prior
    config: SolveConfig
    scenes: Scenes  # of its frames: what they show, weights and covariance count by them
    seed: int  # of the bootstrap: solutions compare on the same resampled days
    tz_variance: float  # [m2]
    tz_common_share: float = 1.0  # of its variance, the same every day

    @property
    def common_share(self) -> Float[np.ndarray, " 8"]:
        """Share of the variance not from gradients that is common to all days: all of a prior's, part of tz's."""
        return np.where(IS_TZ, self.tz_common_share, 1.0)

    def scored(self, kernel: KernelSettings) -> Scored:
        """Its score and prior at a kernel."""
        return Scored(self.terms, kernel, self.prior, self.config)


@dataclass(frozen=True, eq=False)
class ObservabilityAnalysis:
    """A solution, and which of its degrees of freedom the day determined (coordinates of `AlignmentState.changed`)."""

    prior: Prior  # with the tz that was found
    state: AlignmentState
    kernel: KernelSettings
    fixed: np.ndarray  # 8, bool: at the prior
    covariance: np.ndarray  # 8 8
    common: np.ndarray  # 8 8, of the covariance what all days of a vehicle err by alike
    considered: tuple[Considered, ...]  # of the common part what is no prior's
    observability: np.ndarray  # 6
    profile: TzProfile


def analyse_observability(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, rng: np.random.Generator
) -> ObservabilityAnalysis:
    """Fix tz by its profile, then solve again with undetermined degrees of freedom fixed at the prior.

    A free one would move as far as its prior allows and change others: lane lines move tz, and with it dt, by
    decimetres.
    """
    at_own_tz = replace(problem, prior=with_tz(problem.prior, float(state.T_camera_lidar[2, 3])))
    follow = response(_curvature(problem, state, kernel), IS_TZ, np.zeros(8, bool))[:, 0]
    profile = profile_tz(problem.scored(kernel), state, follow)
    timed = _timed(at_own_tz, state, kernel, rng)
    state = timed.state
    kernel = weighted(problem.terms, state, problem.terms.fitted(state.alone, kernel, rng), problem.scenes)
    follow = response(_curvature(problem, state, kernel), IS_TZ, _IS_FOCAL)[:, 0]
    prior_tz_m, prior_sigma_m = float(problem.prior.T_camera_lidar[2, 3]), problem.prior.translation_sigma_m
    tz_m, variance, common_share = profile.with_prior(prior_tz_m, prior_sigma_m)
    tz_observability = 1 - variance / prior_sigma_m**2
    if tz_observability < OBSERVABLE:
        tz_m, variance, common_share = prior_tz_m, prior_sigma_m**2, 1.0
    problem = replace(
        problem,
        prior=with_tz(problem.prior, tz_m),
        tz_variance=variance,
        tz_common_share=common_share,
    )
    if tz_m != state.T_camera_lidar[2, 3]:
        state = state.stepped(follow * (tz_m - state.T_camera_lidar[2, 3]))
        timed = _timed(problem, state, kernel, rng)
    found = _fix_unobservable(problem, timed.state, kernel, rng)
    T, velocity = found.state.T_camera_lidar, problem.terms.velocity_lidar
    along = CAMERA_LIDAR_DT_FLOOR_S * along_the_way(T, velocity, found.fixed)
    in_time = left_out_in_time(timed, found.fixed)
    considered = (
        *found.day.floors,
        Considered("borders", _borders(problem, found)),
        Considered("along_paint", _along_paint(problem, found)),
        Considered("travel", along[None]),
        Considered("traffic", in_time),
    )
    shared = considered_covariance(considered)
    covariance = found.day.scatter + shared
    timed = replace(timed, variance_s2=timed.variance_s2 + float(np.sum(in_time[:, DT] ** 2)))
    covariance[DT, DT] = time_offset_variance(problem, found.state, found.kernel, timed)
    found.observability[TZ] = max(tz_observability, 0.0)
    return ObservabilityAnalysis(
        problem.prior,
        found.state,
        found.kernel,
        found.fixed,
        covariance,
        found.day.of_prior + shared,
        considered,
        found.observability,
        profile,
    )


def along_the_way(
    T_camera_lidar: Float[np.ndarray, "4 4"],
    velocity_lidar: Float[np.ndarray, "F 3"],
    fixed: Bool[np.ndarray, " 8"],
) -> Float[np.ndarray, " 8"]:
    """Motion of the lidar's origin along the driving direction per second of time offset: unobservable at one speed.

    For a camera that looks ahead this is its tz, which is at its prior or from its profile; for one that
    looks to the side it is its x.
    """
    out = np.zeros(8)
    out[3:6] = T_camera_lidar[:3, :3] @ velocity_lidar.mean(0)
    return np.where(fixed, 0.0, out)


@dataclass(frozen=True, eq=False)
class _Determined:
    """A solution whose degrees of freedom are determined by the day or fixed at the prior."""

    state: AlignmentState
    kernel: KernelSettings
    fixed: np.ndarray  # 8, bool
    observability: np.ndarray  # 6
    day: DayCovariance


def _fix_unobservable(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, rng: np.random.Generator
) -> _Determined:
    """Solve again and again until all degrees of freedom are determined or fixed.

    Fixing one can make another undetermined if its optimum depends on the first, so one pass is not enough.
    """
    fixed, observability = IS_TZ, np.ones(6)
    while True:
        # The time offset stays where its profile has it: free together with the focal length, it would wander off
        # again.
        solved_for = fixed | _IS_DT
        steps = SCHEDULE.steps_before_weights
        state = refine(problem.scored(kernel), state, steps=steps, fixed=solved_for)
        kernel = weighted(
            problem.terms, state, problem.terms.fitted(state.alone, kernel, rng), problem.scenes
        )
        steps = SCHEDULE.steps_after_weights
        state = refine(problem.scored(kernel), state, steps=steps, fixed=solved_for)
        day = day_covariance(problem, state, kernel, fixed)
        observability = np.where(fixed[:6], observability, day.observability)
        more_fixed = fixed | np.append(observability < OBSERVABLE, [False, False])
        if more_fixed.sum() == fixed.sum():
            return _Determined(state, kernel, fixed, observability, day)
        fixed = more_fixed


# Labels that are off make an answer unsure. They do not make the prior the better answer: after what is fixed.


def _borders(problem: CameraLidarProblem, found: _Determined) -> Float[np.ndarray, "K 8"]:
    curvature, variance = _curvature(problem, found.state, found.kernel), _prior_variance(problem)
    return border_errors(problem.terms, found.state, found.kernel, curvature, variance, found.fixed)


def _along_paint(problem: CameraLidarProblem, found: _Determined) -> Float[np.ndarray, "K 8"]:
    unpainted = replace(problem, terms=problem.terms.of_kinds(edges=True, markings=False))
    curvature = _curvature(unpainted, found.state, found.kernel)
    return along_paint(problem.terms, found.state, found.kernel, curvature, found.fixed)


def _timed(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, rng: np.random.Generator
) -> TimeOffsetProfile:
    """The time offset's profile from a part of the points: edges that are in view at every possible offset."""
    reach_s = _REACH_SIGMAS * problem.config.time_offset_sigma_s
    ends = replace(state, dt_s=0.0, focal=1.0).changed(np.outer([-reach_s, reach_s], _IS_DT))
    terms = problem.terms.seen_throughout(ends).at_most(SCHEDULE.time_offset_points, rng)
    some = replace(problem.scored(kernel), terms=terms)
    found = profile_time_offset(some, state, IS_TZ, problem.scenes.block)
    # The alignment saw all edges: where they drew it further than a profile reaches back, it begins anew.
    if max(abs(state.dt_s), abs(found.state.dt_s)) <= SCHEDULE.time_offset_reach_s:
        return found
    anew = profile_time_offset(some, replace(state, dt_s=0.0), IS_TZ, problem.scenes.block)
    return anew if anew.score > found.score else found


def time_offset_variance(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, timed: TimeOffsetProfile
) -> float:
    """Variance of the profile, its floor, and the uncertainty due to tz and focal length [s2]; at most the prior's."""
    curvature = _curvature(problem, state, kernel)
    of_tz = response(curvature, IS_TZ, _IS_FOCAL)[DT, 0] ** 2 * problem.tz_variance
    of_focal = response(curvature, _IS_FOCAL, IS_TZ)[DT, 0] * FOCAL_SIGMA
    day_variance = timed.variance_s2 + CAMERA_LIDAR_DT_FLOOR_S**2 + of_tz + of_focal**2
    return 1 / (1 / day_variance + 1 / problem.config.time_offset_sigma_s**2)


@dataclass(frozen=True, eq=False)
class DayCovariance:
    """Covariance and observability of one day's solution by its frames and its prior, without what is considered.

    Args:
        of_prior: of the scatter what all days of a vehicle err by alike.
        floors: what masks and intrinsics move, which is part of the observability.
    """

    scatter: Float[np.ndarray, "8 8"]
    of_prior: Float[np.ndarray, "8 8"]
    floors: tuple[Considered, ...]
    observability: Float[np.ndarray, " 6"]


def day_covariance(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, fixed: Bool[np.ndarray, " 8"]
) -> DayCovariance:
    """Covariance of a solution, and observability.

    Fixed unknowns have their prior's variance, which is propagated to the others.
    """
    terms, prior_variance = problem.terms, _prior_variance(problem)
    scale, curvature = scales(terms, kernel), _curvature(problem, state, kernel)
    gradient = derivatives(terms, state, kernel, scale)[0] / scale
    # After `weighted`, the scatter of the gradients over scenes is the curvature, without its roughness
    # (Bartlett's identity).
    information = problem.scenes.inflation(gradient * scale) * gradient[:, :, None] * gradient[:, None, :]
    covariance = covariance_with_fixed(
        information,
        -gradient,
        prior_variance,
        curvature,
        fixed,
        problem.scenes.block,
        np.random.default_rng(problem.seed),
        SCENE_DEGREES,
    )
    floor = np.where(fixed, 0.0, np.append(CAMERA_LIDAR_BIAS, [CAMERA_LIDAR_DT_FLOOR_S, 0.0]))
    turns = np.arange(8) < 3
    floors = Considered("masks", np.diag(floor)[turns]), Considered("positions", np.diag(floor)[~turns])
    observability = np.clip(1 - (np.diag(covariance) + floor**2) / prior_variance, 0.0, 1.0)[:6]
    of_prior = prior_share(covariance, np.diag(problem.common_share / prior_variance))
    return DayCovariance(covariance, of_prior, floors, observability)


def _prior_variance(problem: CameraLidarProblem) -> Float[np.ndarray, " 8"]:
    """Variance of every unknown before the frames' gradients are used; for tz, that of its profile."""
    rotation, translation = problem.prior.rotation_sigma_rad, problem.prior.translation_sigma_m
    others = [problem.config.time_offset_sigma_s, FOCAL_SIGMA]
    sigma = np.array([rotation] * 3 + [translation] * 3 + others)
    return np.where(IS_TZ, problem.tz_variance, sigma**2)


def _curvature(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings
) -> Float[np.ndarray, "8 8"]:
    """Curvature of the cost without its roughness, in the coordinates of `changed`: Gauss-Newton of the points' slopes.

    Used for ratios only. Moving tz on real logs moves dt by -0.04 s/m: this predicts -0.03, response surfaces +0.1 to
    -0.1.
    """
    _, information = problem.terms.gradient(state.alone, kernel)
    to_left = np.eye(8)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(state.T_camera_lidar))
    return to_left.T @ information.sum(0) @ to_left + np.diag(1 / _prior_variance(problem))


# --------------------------------------------------------------------------------------------------
# First and last part of a day, each with a camera-lidar rotation of its own, to see whether a sensor moved.

_IS_TURN = np.arange(8) < 3
# Of each part's rotation without labels: a step of brightness shows no side, so parts of other scenes match other
# borders. On a real and on a simulated day on which nothing moved, parts were .30 and .25 deg apart at a sigma of .06.
_UNLABELLED_PART_RAD = float(np.radians(0.07))


def parts_of_alignment(
    problem: CameraLidarProblem, analysis: ObservabilityAnalysis, frames: Sequence[Observation]
) -> DayParts | None:
    """First and last part of the day, turned alone, from wide kernels to sharp ones: knocks may be wider than those."""
    kernels = [replace(analysis.kernel, sigma_px=SCHEDULE.kernels[0][0]), analysis.kernel]
    start, terms = analysis.state, problem.terms
    at_start = replace(problem.prior, T_camera_lidar=start.T_camera_lidar)
    gradients = [derivatives(terms, start, k, scales(terms, k))[0][:, :3] for k in kernels]
    floor = np.eye(3) * (_UNLABELLED_PART_RAD**2 if frames[0].is_unlabelled else 0.0)

    def solve(rows: np.ndarray) -> tuple[AlignmentState, np.ndarray, np.ndarray]:
        part, state = terms.of_frames(rows), start
        for kernel in kernels:
            scored = Scored(part, kernel, at_start, problem.config)
            state = refine(scored, state, steps=SCHEDULE.part_steps, fixed=~_IS_TURN)
        # Weighted anew: the scatter of the whole day counts the step itself as noise.
        scenes = problem.scenes.of_frames(rows)
        kernel, scale = weighted(part, state, analysis.kernel, scenes), scales(part, analysis.kernel)
        g = (derivatives(part, state, kernel, scale)[0] / scale)[:, :3]
        prior_information = np.eye(3) / problem.prior.rotation_sigma_rad**2
        rng = np.random.default_rng(problem.seed)
        information = scenes.inflation(g) * g[:, :, None] * g[:, None, :]
        spread = bootstrap_covariance(information, -g, prior_information, scenes.block, rng)
        return state, state.T_camera_lidar, spread + floor

    def score(state: AlignmentState) -> Float[np.ndarray, " F"]:
        return np.sum([terms.score(state.alone, k)[0] for k in kernels], axis=0)

    stamps = [o.stamp_ns for o in frames]
    return parts_of_day(
        np.concatenate(gradients, axis=1), stamps, solve, score, (0, 1, 2), problem.scenes.block
    )
