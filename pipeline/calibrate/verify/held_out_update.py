"""A second opinion on a pose: how far frames that took no part in the fit would move it, and how sure they are.

That held-out frames align better at the result than at a prior two degrees off says little of the result. Asked where
their own optimum lies, they say much: it must be near the result, by the sigmas of both. The result, with its
covariance, is the prior of this question; scores of the held-out frames are log likelihoods that promise too much
(points of one scene err together), so they are weighed down until their curvature equals their scatter over blocks.

Source: Varin, Reid, Firth 2011, section 2.3 (composite likelihoods); Kalman 1960 for the update and its innovation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, stdtrit

__all__ = ["SecondOpinion", "Slopes", "second_opinion"]

# (step from the result: left perturbation 6, time offset, nuisance; kernel width, 1 = sharp) -> gradient of each
# frame's log likelihood, and its information, both by the step.
Slopes = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]
_FEWEST_BLOCKS = 3
_STEP_SIGMAS = 2.0  # of the result: a quadratic is good near by only
_SIGMAS = 3.0  # where contradiction begins


@dataclass(frozen=True, eq=False)
class SecondOpinion:
    """Result and held-out frames together, against the result alone."""

    shift: Float[np.ndarray, " 6"]  # left perturbation that leads from the result to both together
    covariance: Float[np.ndarray, "6 6"]  # of both together
    shift_covariance: Float[np.ndarray, "6 6"]  # of the shift, if both are as good as they say
    bias: Float[np.ndarray, "6 6"]  # of the held-out frames, which no number of them lowers
    inflation: float  # by how much the scores promised too much
    blocks: int


def second_opinion(
    slopes: Slopes,
    covariance: Float[np.ndarray, "P P"],
    bias: Float[np.ndarray, " P"],
    blocks: Int[np.ndarray, " F"],
    widths: Sequence[float] = (3.0, 1.5, 1.0, 1.0),
) -> SecondOpinion | None:
    """Ask the held-out frames.

    Args:
        slopes: gradient and information of each held-out frame's log likelihood.
        covariance: of the result, its time offset and nuisance.
        bias: sigma of errors that are common to all held-out frames.
        blocks: frames of equal number share a scene.
        widths: kernel widths, from wide to sharp: an optimum that is far off is seen by wide kernels only.

    Returns:
        None where fewer than three blocks say anything.
    """
    prior = np.linalg.inv(covariance)
    x, J, inflation, count = np.zeros(len(bias)), np.zeros_like(covariance), 1.0, 0
    for width in widths:
        g, H = slopes(x, width)
        told = np.abs(g).sum(axis=1) > 0
        count = len(np.unique(blocks[told]))
        if count < _FEWEST_BLOCKS:
            return None
        information = _positive(H.sum(axis=0))
        inflation = _inflation(g[told], information, blocks[told])
        J, towards = information / inflation, g.sum(axis=0) / inflation
        # Information of a measurement whose own errors are J^-1 plus a common bias.
        less = np.linalg.inv(np.eye(len(x)) + J * bias**2)
        J, own = less @ J, less @ (towards + J @ x)
        step = np.linalg.solve(prior + J, own) - x
        x = x + step * min(1.0, _STEP_SIGMAS / max(float(np.sqrt(step @ prior @ step)), 1e-12))
    both = np.linalg.inv(prior + J)
    at = np.ix_(range(6), range(6))
    shift_covariance = covariance - both
    return SecondOpinion(
        x[:6],
        both[at],
        0.5 * (shift_covariance + shift_covariance.T)[at],
        np.diag(bias[:6] ** 2),
        inflation,
        count,
    )


def _positive(H: np.ndarray) -> np.ndarray:
    """The positive part of a symmetric matrix whose scales differ by orders."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-12))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale)


def _inflation(g: np.ndarray, information: np.ndarray, blocks: np.ndarray) -> float:
    """Scatter of the gradients over blocks, in units of what the information promises; at least 1."""
    names, index = np.unique(blocks, return_inverse=True)
    B = len(names)
    sums = np.zeros((B, g.shape[1]))
    np.add.at(sums, index.ravel(), g - g.mean(axis=0))
    scatter = (sums**2).sum(axis=0) * B / (B - 1)
    promised = np.diag(information)
    some = promised > 0
    # Few blocks often scatter less than they should: three sigmas then reach as far as Student's t does.
    few = float(stdtrit(B - 1, ndtr(_SIGMAS))) / _SIGMAS
    return max(1.0, float(np.mean(scatter[some] / promised[some]))) * few**2
