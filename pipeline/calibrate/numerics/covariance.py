"""Covariance of a pose: information matrix, block bootstrap over drives, and a bias floor.

The inverse of an information matrix alone is too small (on real logs by a factor of 6 in yaw), because
residuals of one scene are correlated. Instead, blocks of frames without a common scene are resampled. Each
resampled day moves the estimate by one Newton step, and the covariance is the spread of these steps plus the
prior's uncertainty. A block that makes up much of the day pulls the estimate towards itself, so its error
seems small; its step counts as if the block had been left out. The spread of few blocks is uncertain, so it
is widened like Student's t. No variance is smaller than the information allows. A bias common to all frames,
which resampling does not show, is added as a floor per degree of freedom.

Source: Efron & Tibshirani 1993, ch. 8 (blocks); White 1982 (the sandwich that one Newton step per resample
tends to); MacKinnon & White 1985 (HC3, what is left out); Satterthwaite 1946 (blocks of unequal weight).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from scipy.special import ndtri, stdtrit

from pipeline.rig.se3 import exp_se3

__all__ = [
    "CLEARLY", "DESIGN", "OBSERVABLE", "Posterior", "at_least", "bootstrap_covariance",
    "covariance_with_fixed", "fit_quadratics", "inverse_of_information", "posterior", "response",
    "sandwich_covariance", "spread_to_covariance", "widening",
]  # fmt: skip

CLEARLY = 4.0  # standard errors by which frames reject the end of another start
OBSERVABLE = 0.5  # the day at least halved the variance
_WIDENED_AT = 0.975  # where Student's t and the normal are compared: 95 % of what is told by two sigmas


@dataclass(frozen=True, eq=False)
class Posterior:
    """Covariance (left perturbation, rad and m), observability 0..1 per DoF and which DoF the day determined."""

    covariance: Float[np.ndarray, "6 6"]
    observability: Float[np.ndarray, " 6"]
    observable: Bool[np.ndarray, " 6"]


def bootstrap_covariance(
    information: Float[np.ndarray, "F P P"], score: Float[np.ndarray, "F P"],
    prior_information: Float[np.ndarray, "P P"], block: Int64[np.ndarray, " F"], rng: np.random.Generator,
    resamples: int = 200, degrees: float = 0.0,
) -> Float[np.ndarray, "P P"]:  # fmt: skip
    """Covariance of a MAP estimate by resampling blocks of frames.

    Args:
        information: information of each frame (second derivative of its cost), at the estimate.
        prior_information: information of the prior; zero if there is none (the frames must then determine
            that parameter).
        block: frames with the same number are drawn together.
        degrees: degrees of freedom of the scatter over blocks that the information already contains; 0 if it
            treats frames as independent.

    Returns:
        Spread of the resampled estimates plus the prior's share, at least the inverse of all information. A
        single block has no spread: the result is then the inverse, widened as for two blocks if the
        information treats frames as independent.
    """
    P = score.shape[1]
    count = int(block.max()) + 1 if len(block) else 0
    H, g = np.zeros((count, P, P)), np.zeros((count, P))
    np.add.at(H, block, information)
    np.add.at(g, block, score)
    total = H.sum(0) + prior_information
    inverse = inverse_of_information(total)
    share = np.maximum(np.einsum("ij,bji->b", inverse, H) / P, 0.0)
    equal = float(share.sum() ** 2 / max((share**2).sum(), 1e-300))
    few = widening(equal + degrees)
    if count < 2 and not degrees:
        return inverse * few**2
    draws = rng.multinomial(count, np.full(count, 1 / count), size=resamples).astype(float)
    left_out = (g - g.mean(0)) / np.maximum(1 - share, 1 / count)[:, None]
    steps = (draws @ (left_out - left_out.mean(0))) @ inverse.T
    shown = np.cov(steps.T, ddof=1) * (count - 1) / count
    said = inverse @ H.sum(0) @ inverse
    spread = (degrees * said + (equal - 1) * shown) / (degrees + equal - 1) if degrees else shown
    return spread_to_covariance(few**2 * spread + inverse @ prior_information @ inverse, inverse)


def widening(blocks: float) -> float:
    """Ratio of the widths of Student's t and a normal distribution, for the spread over so many equal blocks."""
    return float(stdtrit(max(blocks - 1, 1.0), _WIDENED_AT) / ndtri(_WIDENED_AT))


def response(
    curvature: Float[np.ndarray, "P P"], given: Bool[np.ndarray, " P"], fixed: Bool[np.ndarray, " P"]
) -> Float[np.ndarray, "P G"]:
    """Change of the optimum when the `given` parameters move by one unit; `fixed` ones stay."""
    out = np.zeros((len(given), int(given.sum())))
    out[given] = np.eye(out.shape[1])
    free = ~given & ~fixed
    out[free] = -np.linalg.solve(curvature[np.ix_(free, free)], curvature[np.ix_(free, given)])
    return out


def covariance_with_fixed(
    information: Float[np.ndarray, "F P P"], score: Float[np.ndarray, "F P"],
    prior_variance: Float[np.ndarray, " P"], curvature: Float[np.ndarray, "P P"],
    fixed: Bool[np.ndarray, " P"], block: Int64[np.ndarray, " F"], rng: np.random.Generator,
    degrees: float = 0.0,
) -> Float[np.ndarray, "P P"]:  # fmt: skip
    """Covariance of a MAP estimate some of whose parameters were fixed at the prior.

    Args:
        prior_variance: of every parameter, independent.
        curvature: curvature of the whole cost, prior included; gives the change of the others with a fixed
            parameter.
        fixed: parameters that the frames did not move.

    Returns:
        The free parameters' covariance given the fixed ones, plus the prior uncertainty of the fixed ones,
        propagated to all parameters.
    """
    at = np.ix_(~fixed, ~fixed)
    out = np.zeros((len(fixed), len(fixed)))
    prior_information = np.diag(1 / prior_variance[~fixed])
    out[at] = bootstrap_covariance(
        information[:, ~fixed][:, :, ~fixed], score[:, ~fixed], prior_information, block, rng,
        degrees=degrees,
    )  # fmt: skip
    along = response(curvature, fixed, np.zeros_like(fixed))
    return out + (along * prior_variance[fixed]) @ along.T


def spread_to_covariance(
    spread: Float[np.ndarray, "P P"], least: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """The larger of two covariances in every direction (in the eigenbasis of one whitened by the other)."""
    L = np.linalg.cholesky(least)
    W = np.linalg.solve(L, np.linalg.solve(L, spread).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = L @ vectors
    return (root * np.maximum(values, 1.0)) @ root.T


def posterior(
    covariance: Float[np.ndarray, "6 6"],
    prior_covariance: Float[np.ndarray, "6 6"],
    bias_floor: Float[np.ndarray, " 6"],
) -> Posterior:
    """Add the bias floor and compare with the prior.

    Args:
        bias_floor: sigma per DoF of errors common to all frames [rad, m].

    Returns:
        Observability 1 - posterior/prior variance (0 = the day added nothing); a DoF below 0.5 is not
            observable, and
        its sigma is at least the prior's.
    """
    full = covariance + np.diag(bias_floor**2)
    variance, before = np.diag(full), np.diag(prior_covariance)
    observability = np.clip(1 - variance / before, 0.0, 1.0)
    observable = observability >= OBSERVABLE
    # An unobservable DoF keeps the prior's sigma: widen its row and column, correlations stay.
    scale = np.where(observable, 1.0, np.sqrt(np.maximum(before / variance, 1.0)))
    return Posterior(full * np.outer(scale, scale), observability, observable)


def inverse_of_information(information: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Inverse of a positive definite matrix whose scales differ by many orders."""
    scale = 1 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(0.5 * (inverse + inverse.T))


# --------------------------------------------------------------------------------------------------
# Quadratic response surfaces over a ball: gradients and curvatures of scores that are rough at small scale.
#
# Source: Box & Wilson 1951; antithetic pairs make gradient and curvature errors independent.

_DIMENSIONS = 8


def _design() -> Float[np.ndarray, "P 8"]:
    """Centre and antithetic pairs in the unit ball, the same for every call."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(66, _DIMENSIONS))
    x *= (rng.random((66, 1)) ** (1 / 3)) / np.linalg.norm(x, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, _DIMENSIONS)), x, -x])


DESIGN = _design()
_UPPER = np.triu_indices(_DIMENSIONS)
_FIT = np.linalg.pinv(
    np.column_stack([np.ones(len(DESIGN)), DESIGN, DESIGN[:, _UPPER[0]] * DESIGN[:, _UPPER[1]]])
)


def fit_quadratics(
    value: Float[np.ndarray, "P F"],
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of the least-squares quadratic through each frame's values on the design."""
    c = (_FIT @ value).T
    H = np.zeros((value.shape[1], _DIMENSIONS, _DIMENSIONS))
    H[:, _UPPER[0], _UPPER[1]] = c[:, 1 + _DIMENSIONS :]
    return c[:, 1 : 1 + _DIMENSIONS], H + H.transpose(0, 2, 1)


def at_least(
    curvature: Float[np.ndarray, "8 8"], least: Float[np.ndarray, "8 8"]
) -> Float[np.ndarray, "8 8"]:
    """The larger of two symmetric matrices in every direction; `least` must be positive definite."""
    return spread_to_covariance(0.5 * (curvature + curvature.T), least)


# --------------------------------------------------------------------------------------------------
# Covariance of a minimum of the paper's losses: block sandwich from curvature and the scatter of gradients.
#
# The paper gives no uncertainty. The sandwich `H^-1 S H^-1` (H: curvature of the mean loss, S: scatter of
# the gradients over blocks of frames that share a scene) is what resampling whole blocks converges to, at
# the price of a few evaluations; its inverse is added to the prior's information. It does not include bias,
# and these losses are biased (their minimum lies below the truth's value): a floor measured in simulation
# is added.


_STEP = np.array([np.radians(0.2)] * 3 + [0.04] * 3)


def sandwich_covariance(
    frame_losses: Callable[[np.ndarray], np.ndarray],
    T: Float[np.ndarray, "4 4"],
    blocks: Int[np.ndarray, " F"],
    prior_covariance: Float[np.ndarray, "6 6"],
    floor: tuple[float, float],
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"]]:
    """Covariance (left perturbation, rotation first) with the bias floor, and observability per DoF.

    Args:
        frame_losses: (P, 4, 4) -> (P, F).
        prior_covariance: upper limit for what is not determined.
        floor: bias floor, rotation [rad] and translation [m].

    Returns:
        Covariance, and 1 - variance / prior variance per DoF, clipped to 0..1.
    """
    E = np.diag(_STEP)
    plus, minus = frame_losses(exp_se3(E) @ T), frame_losses(exp_se3(-E) @ T)
    gradients = (plus - minus) / (2 * _STEP[:, None])  # 6 F
    frames = gradients.shape[1]
    names = np.unique(blocks)
    sums = np.stack([gradients[:, blocks == b].sum(axis=1) for b in names]) / frames
    sums -= sums.mean(axis=0)
    S = sums.T @ sums * len(names) / max(len(names) - 1, 1)
    H = _curvature(frame_losses, T, plus.mean(axis=1), minus.mean(axis=1))
    information = _godambe(H, S) + np.linalg.inv(prior_covariance)
    covariance = np.linalg.inv(information) + np.diag([floor[0] ** 2] * 3 + [floor[1] ** 2] * 3)
    covariance = (covariance + covariance.T) / 2
    observability = np.clip(1 - np.diag(covariance) / np.diag(prior_covariance), 0, 1)
    return covariance, observability


def _curvature(
    frame_losses: Callable[[np.ndarray], np.ndarray], T: np.ndarray, plus: np.ndarray, minus: np.ndarray
) -> np.ndarray:
    centre = frame_losses(T[None]).mean()
    H = np.diag((plus + minus - 2 * centre) / _STEP**2)
    for i in range(6):
        for j in range(i):
            signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], float)
            xi = np.zeros((4, 6))
            xi[:, [i, j]] = signs * _STEP[[i, j]]
            f = frame_losses(exp_se3(xi) @ T).mean(axis=1)
            H[i, j] = H[j, i] = (f[0] - f[1] - f[2] + f[3]) / (4 * _STEP[i] * _STEP[j])
    return H


def _godambe(H: np.ndarray, S: np.ndarray) -> np.ndarray:
    """H S^-1 H, the inverse of the sandwich; 0 in directions in which both H and S vanish."""
    scale = _STEP[:, None] * _STEP[None]
    values, vectors = np.linalg.eigh(H * scale)
    positive = (vectors * np.maximum(values, 0)) @ vectors.T
    scatter = S * scale
    floor = 1e-3 * max(float(np.linalg.eigvalsh(scatter).max()), 1e-15)
    return positive @ np.linalg.solve(scatter + floor * np.eye(6), positive) / scale
