"""What held-out frames show of a result: a paired test against the prior, an innovation, and another place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar
from pipeline.calibrate.reasons import because
from pipeline.core.config import ChecksConfig, SolveConfig
from pipeline.core.errors import SolveError
from pipeline.rig.estimates import Check, PairEstimate, Prior, change_of
from pipeline.rig.se3 import change_between
from pipeline.rig.targets import errors_at_targets
from schemas.observations import Observation

__all__ = [
    "FrameDerivatives", "HeldOutTest", "HeldOutUpdate", "found_elsewhere", "held_out_place",
    "held_out_update", "paired_test",
]  # fmt: skip

# --------------------------------------------------------------------------------------------------
# Alignment of held-out frames at the prior and at the result: a paired test over scenes of equal weight.
#
# A standing car logs one scene many times: 13 of 40 held-out frames of the real day are from two seconds. With
# equal weights of frames, they alone rejected a result that improved every other scene.


@dataclass(frozen=True)
class HeldOutTest:
    """Mean over blocks of the cost at the prior and at the result, of frames with both, and its significance."""

    before: float
    after: float
    standard_error: float  # of after - before, from the scatter of blocks
    frames: int
    blocks: int

    @property
    def z(self) -> float:
        """Significance of after - before as a normal deviate: negative = better aligned, 0 where nothing changed.

        Student's t with one degree of freedom less than blocks is converted to the normal deviate of the same
        probability, so that a chance agreement of two blocks is not a 30-sigma result. Limited to +-8.
        """
        difference = self.after - self.before
        if difference == 0:
            return 0.0
        ratio = abs(difference) / self.standard_error if self.standard_error > 0 else np.inf
        tail = max(float(stdtr(max(self.blocks - 1, 1), -ratio)), 1e-15)
        return float(-np.sign(difference) * ndtri(tail))


def paired_test(
    before: Float[np.ndarray, " F"], after: Float[np.ndarray, " F"], blocks: Int[np.ndarray, " F"]
) -> HeldOutTest | None:
    """Compare the costs of the same frames at two calibrations (lower is better); None without frames.

    Frames with a cost that is not finite are left out. Blocks (scenes), not frames, are independent and count
    once each, by their mean; a single block counts by its frames.
    """
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    before, after, blocks = before[both], after[both], blocks[both]
    names, index = np.unique(blocks, return_inverse=True)
    if len(names) == 1:
        names, index = np.arange(len(before)), np.arange(len(before))
    frames, B = np.bincount(index), len(names)
    before, after = np.bincount(index, before) / frames, np.bincount(index, after) / frames
    error = float(np.std(after - before, ddof=1) / np.sqrt(B)) if B > 1 else 0.0
    return HeldOutTest(float(before.mean()), float(after.mean()), error, int(both.sum()), B)


# --------------------------------------------------------------------------------------------------
# An innovation test on held-out frames: the move of the result that they would cause, and its sigma.
#
# A better alignment of held-out frames at the result than at a prior two degrees off proves little. Their own
# optimum proves more: it must be near the result, by the sigmas of both. So the result, with its covariance, is
# the prior of a Kalman update by the held-out frames. Their scores are sums of log likelihoods of points whose
# errors are correlated within a scene, so their information is too large. It is divided by the ratio of the
# gradients' scatter over scenes to that information.
#
# Source: Varin, Reid, Firth 2011, section 2.3 (composite likelihoods); Kalman 1960 for the update and its
# innovation.


# (step from the result: left perturbation 6, time offset, nuisance; kernel width, 1 = sharp) -> gradient of each
# frame's log likelihood (F 8), and its information (F 8 8), both with respect to the step.
FrameDerivatives = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]


# One Newton step per kernel width, from wide to sharp: an optimum that is far off is seen by wide kernels only; the
# last is done twice to converge. Each is no longer than some sigmas of the result: the quadratic holds nearby only.
_WIDTHS, _MAX_STEP_SIGMAS = (3.0, 1.5, 1.0, 1.0), 2.0


@dataclass(frozen=True, eq=False)
class HeldOutUpdate:
    """The result updated by the held-out frames, compared with the result alone."""

    shift: Float[np.ndarray, " 6"]  # left perturbation that leads from the result to the updated one [rad, m]
    covariance: Float[np.ndarray, "6 6"]  # of the updated result
    shift_covariance: Float[np.ndarray, "6 6"]  # of the shift, if both covariances are right
    bias: Float[np.ndarray, "6 6"]  # covariance of what all held-out frames err by alike


def held_out_update(
    derivatives: FrameDerivatives,
    covariance: Float[np.ndarray, "P P"],
    bias: Float[np.ndarray, " P"],
    blocks: Int[np.ndarray, " F"],
    limits: ChecksConfig | None = None,
) -> HeldOutUpdate | None:
    """Update the result by the held-out frames.

    Args:
        covariance: covariance of the result, its time offset and nuisance.
        bias: sigma of errors that are common to all held-out frames.
        blocks: frames of equal number share a scene.
        limits: smallest number of blocks, and the number of sigmas of a contradiction; None = the defaults.

    Returns:
        None if fewer than `min_held_out_blocks` blocks have a gradient.
    """
    limits = limits or ChecksConfig()
    prior = np.linalg.inv(covariance)
    x, J = np.zeros(len(bias)), np.zeros_like(covariance)
    for width in _WIDTHS:
        g, H = derivatives(x, width)
        informative = np.abs(g).sum(axis=1) > 0
        if len(np.unique(blocks[informative])) < limits.min_held_out_blocks:
            return None
        information = _positive_part(H.sum(axis=0))
        sigmas = limits.held_out_contradiction_sigmas
        inflation = _inflation(g[informative], information, blocks[informative], sigmas)
        J, gradient = information / inflation, g.sum(axis=0) / inflation
        # Information of a measurement whose own errors are J^-1 plus a common bias.
        less = np.linalg.inv(np.eye(len(x)) + J * bias**2)
        J, measured = less @ J, less @ (gradient + J @ x)
        step = np.linalg.solve(prior + J, measured) - x
        length = max(float(np.sqrt(step @ prior @ step)), 1e-12)
        x = x + step * min(1.0, _MAX_STEP_SIGMAS / length)
    updated = np.linalg.inv(prior + J)
    pose = np.ix_(range(6), range(6))
    shift_covariance = covariance - updated
    return HeldOutUpdate(
        x[:6], updated[pose], 0.5 * (shift_covariance + shift_covariance.T)[pose], np.diag(bias[:6] ** 2)
    )


def _positive_part(H: np.ndarray) -> np.ndarray:
    """The positive part of a symmetric matrix whose scales differ by orders of magnitude."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-12))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale)


def _inflation(g: np.ndarray, information: np.ndarray, blocks: np.ndarray, sigmas: float) -> float:
    """Scatter of the gradients over blocks, divided by the information's prediction; at least 1."""
    names, index = np.unique(blocks, return_inverse=True)
    B = len(names)
    sums = np.zeros((B, g.shape[1]))
    np.add.at(sums, index.ravel(), g - g.mean(axis=0))
    scatter = (sums**2).sum(axis=0) * B / (B - 1)
    predicted = np.diag(information)
    some = predicted > 0
    # Few blocks often scatter less than they should: `sigmas` then reach as far as Student's t does.
    few = float(stdtrit(B - 1, ndtr(sigmas))) / sigmas
    return max(1.0, float(np.mean(scatter[some] / predicted[some]))) * few**2


# --------------------------------------------------------------------------------------------------
# Search of camera-lidar on held-out frames: another place that they fit better than the result.
#
# Ten frames can match best in a wrong place, a degree or more from the right one. The other checks by held-out
# frames look near the result, and there they find a place as well. Where held-out frames are more than those of
# the fit, a search on them is more reliable than the result that they judge. It shares labels, CameraInfo and
# prior with the fit: it shows a wrong place, and nothing of errors that all frames have.


_SIGMAS = 3.0  # of the result in azimuth or elevation: nearer is no other place


def held_out_place(
    held_out: Sequence[Observation], prior: Prior, config: SolveConfig
) -> Float[np.ndarray, "4 4"] | None:
    """T_camera_lidar where a search on held-out frames ends; None if they show nothing to align."""
    try:
        return align_camera_lidar(held_out, prior, config, np.random.default_rng(0)).state.T_camera_lidar
    except SolveError:
        return None


def found_elsewhere(
    estimate: PairEstimate, place: Float[np.ndarray, "4 4"], cost: Callable[[np.ndarray], np.ndarray],
    sigma_rad: Float[np.ndarray, " 2"], blocks: Int[np.ndarray, " F"], targets: Float[np.ndarray, "N 3"],
    worse_z: float,
) -> list[Check]:  # fmt: skip
    """A failed check if held-out frames align better at a place that the result's sigma excludes.

    Args:
        estimate: the result.
        place: where a search on the held-out frames ended.
        cost: of each held-out frame at a pose.
        sigma_rad: of the result's azimuth and elevation.
        blocks: block of each held-out frame.
        targets: in the child's frame [m].
        worse_z: significance from which one alignment is worse than another.
    """
    off_rad = errors_at_targets(estimate.pair, estimate.T, place, targets)[:2]
    test = paired_test(cost(estimate.T), cost(place), blocks)
    if test is None or test.z > -worse_z or (off_rad <= _SIGMAS * sigma_rad).all():
        return []
    azimuth, elevation = np.degrees(off_rad)
    sentence = because("elsewhere", azimuth=azimuth, elevation=elevation, z=test.z)
    error = change_of(change_between(estimate.T, place))
    return [Check(sentence, disproves=True, error=error)]
