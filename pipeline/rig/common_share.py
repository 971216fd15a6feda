"""Part of a day's covariance from errors common to all days of a vehicle.

The error of a day has two parts. One is independent from day to day: scenes and noise. The other is the same
every day: bias floors (masks, intrinsics, reflections of cars in radar) and the error of the prior, as far as
estimates depend on it. Averaging over days does not reduce the common part, and changes between days do not
contain it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["common_of", "common_part", "prior_share"]


def prior_share(
    covariance: Float[np.ndarray, "P P"], prior_information: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance of a MAP estimate C due to its prior P, whose error adds `C P^-1 (prior's error)` to it."""
    share = covariance @ prior_information @ covariance
    return 0.5 * (share + share.T)


def common_part(
    common: Float[np.ndarray, "P P"], covariance: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """`common`, limited to `covariance` in every direction, so that the difference is a covariance too."""
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
    """Common covariance of an estimate with one bias floor (a covariance) and one prior."""
    return common_part(bias + prior_share(covariance, np.linalg.inv(prior_covariance)), covariance)
