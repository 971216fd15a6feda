"""First and last part of a day, each with a camera-lidar rotation of its own, to see whether a sensor moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

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
from pipeline.calibrate.numerics.covariance import bootstrap_covariance
from pipeline.rig.estimates import DayParts
from schemas.observations import Observation

__all__ = ["parts_of_alignment"]

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
