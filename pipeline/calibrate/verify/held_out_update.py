"""An innovation test on held-out frames: the move of the result that they would cause, and its sigma.

A better alignment of held-out frames at the result than at a prior two degrees off proves little. Their own
optimum proves more: it must be near the result, by the sigmas of both. So the result, with its covariance, is
the prior of a Kalman update by the held-out frames. Their scores are sums of log likelihoods of points whose
errors are correlated within a scene, so their information is too large. It is divided by the ratio of the
gradients' scatter over scenes to that information.

Source: Varin, Reid, Firth 2011, section 2.3 (composite likelihoods); Kalman 1960 for the update and its
innovation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, stdtrit

from pipeline.core.config import ChecksConfig

__all__ = ["FrameDerivatives", "HeldOutUpdate", "held_out_update"]

# (step from the result: left perturbation 6, time offset, nuisance; kernel width, 1 = sharp) -> gradient of each
# frame's log likelihood (F 8), and its information (F 8 8), both with respect to the step.
FrameDerivatives = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class _Schedule:
    """One Newton step per kernel width, each no longer than some sigmas of the result."""

    # From wide to sharp: an optimum that is far off is seen by wide kernels only; the last is done twice to converge.
    widths: tuple[float, ...] = (3.0, 1.5, 1.0, 1.0)
    max_step_sigmas: float = 2.0  # the quadratic holds nearby only


_SCHEDULE = _Schedule()


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
    for width in _SCHEDULE.widths:
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
        x = x + step * min(1.0, _SCHEDULE.max_step_sigmas / length)
    updated = np.linalg.inv(prior + J)
    pose = np.ix_(range(6), range(6))
    shift_covariance = covariance - updated
    return HeldOutUpdate(
        x[:6],
        updated[pose],
        0.5 * (shift_covariance + shift_covariance.T)[pose],
        np.diag(bias[:6] ** 2),
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
