"""Which part of a day's covariance all days of a vehicle have in common.

A day's error has two parts. One is drawn anew every day: what scenes and noise leave. The other is the same every day,
so that no number of days averages it down, and a change from one day to the next does not show it: bias floors (masks,
intrinsics, how a radar sees cars), and the error of the prior, as far as each day's estimate rests on it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["common_of", "common_part", "prior_share"]


def prior_share(
    covariance: Float[np.ndarray, "P P"], prior_information: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance of a MAP estimate by the prior's own error: `C P^-1 (error of the prior)` is what it adds.

    Args:
        covariance: C, of the estimate, its floors left out.
        prior_information: P^-1.
    """
    share = covariance @ prior_information @ covariance
    return 0.5 * (share + share.T)


def common_part(
    common: Float[np.ndarray, "P P"], covariance: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """`common`, in no direction more than `covariance`, so that what is left of it is a covariance too.

    Args:
        common: what days err by alike, from approximations.
        covariance: of the estimate, positive definite.
    """
    scale = 1 / np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky(covariance * np.outer(scale, scale))
    W = np.linalg.solve(L, np.linalg.solve(L, common * np.outer(scale, scale)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = (L @ vectors) / scale[:, None]
    return (root * np.clip(values, 0.0, 1.0)) @ root.T


def common_of(
    covariance: Float[np.ndarray, "6 6"],
    prior_covariance: Float[np.ndarray, "6 6"],
    bias: Float[np.ndarray, "6 6"],
) -> Float[np.ndarray, "6 6"]:
    """The common part of an estimate whose method states one bias and one prior.

    Args:
        covariance: of the estimate, all included.
        prior_covariance: before the day.
        bias: covariance of the bias floor.
    """
    return common_part(bias + prior_share(covariance, np.linalg.inv(prior_covariance)), covariance)
