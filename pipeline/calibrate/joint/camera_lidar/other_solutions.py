"""The day's solution against others of the same day: where another start led, and those of its first and last part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.initialise import difference
from pipeline.calibrate.joint.camera_lidar.observability import CameraLidarProblem, ObservabilityAnalysis
from pipeline.calibrate.joint.camera_lidar.refine import (
    AlignmentState,
    Scored,
    derivatives,
    refine,
    scales,
    weighted,
)
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.calibrate.numerics.change_point import parts_of_day
from pipeline.calibrate.numerics.covariance import CLEARLY, bootstrap_covariance
from pipeline.rig.estimates import DayParts
from schemas.observations import Observation

__all__ = ["parts_of_alignment", "starts_apart"]

_IS_TURN, _COMPARED = np.arange(8) < 3, np.arange(8) < 5


def starts_apart(
    scored: Scored, analysis: ObservabilityAnalysis, second: AlignmentState | None
) -> Float[np.ndarray, " 8"]:
    """How far from the solution a start of another origin ends; 0 where it ends in a clearly lower place."""
    if second is None:
        return np.zeros(8)
    state = analysis.state
    fixed = analysis.fixed | ~_COMPARED  # their profiles, not their starts, decide tz and the time offset
    end = refine(
        scored, replace(second, dt_s=state.dt_s, focal=state.focal), steps=SCHEDULE.start_steps, fixed=fixed
    )
    here, there = (scored.terms.score(s.alone, scored.kernel)[0] for s in (state, end))
    lower = here - there
    is_rival = lower.mean() < CLEARLY * lower.std() / np.sqrt(len(lower))
    return difference(end, state) * ~fixed if is_rival else np.zeros(8)


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
