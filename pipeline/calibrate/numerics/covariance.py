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

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.special import ndtri, stdtrit

__all__ = [
    "CLEARLY",
    "OBSERVABLE",
    "Posterior",
    "bootstrap_covariance",
    "covariance_with_fixed",
    "posterior",
    "response",
    "spread_to_covariance",
    "widening",
]

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
    information: Float[np.ndarray, "F P P"],
    score: Float[np.ndarray, "F P"],
    prior_information: Float[np.ndarray, "P P"],
    block: Int64[np.ndarray, " F"],
    rng: np.random.Generator,
    resamples: int = 200,
    degrees: float = 0.0,
) -> Float[np.ndarray, "P P"]:
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
    inverse = _inverse(total)
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
    information: Float[np.ndarray, "F P P"],
    score: Float[np.ndarray, "F P"],
    prior_variance: Float[np.ndarray, " P"],
    curvature: Float[np.ndarray, "P P"],
    fixed: Bool[np.ndarray, " P"],
    block: Int64[np.ndarray, " F"],
    rng: np.random.Generator,
    degrees: float = 0.0,
) -> Float[np.ndarray, "P P"]:
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
        information[:, ~fixed][:, :, ~fixed],
        score[:, ~fixed],
        prior_information,
        block,
        rng,
        degrees=degrees,
    )
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


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse of a positive definite matrix whose scales differ by many orders."""
    scale = 1 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return 0.5 * (inverse + inverse.T)
