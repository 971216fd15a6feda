"""Each edge against what all others say of it: the innovation of leaving it out.

An edge without a second way between its sensors has none: what is left to compare with is the prior. Along a direction
that neither the edge nor the others know better than the prior did, a comparison says nothing and is left out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh
from scipy.special import ndtri_exp
from scipy.stats import chi2

from pipeline.calibrate.adjust.equations import Equations, LinearEdge, inverse_of_information

__all__ = ["innovation"]

# Information that stands in for none, as a share of the prior's: an edge is then so much less sure than the prior.
_NONE = 1e-6


def innovation(
    edge: LinearEdge, others: Equations, prior_covariance: Float[np.ndarray, "N N"]
) -> tuple[float, float] | None:
    """Chi-squared of the edge against the others and the prior, and the sigmas of a normal as improbable.

    Args:
        edge: linearised where the others are.
        others: equations without it.
        prior_covariance: of all unknowns before the day.

    Returns:
        None where edge and others together know no direction better than the prior.
    """
    C = inverse_of_information(others.H)
    before = edge.J @ prior_covariance @ edge.J.T
    of_edge = inverse_of_information(edge.W + _NONE * inverse_of_information(before))
    residual = of_edge @ edge.g - edge.x - edge.J @ (C @ others.g)
    covariance = of_edge + edge.J @ C @ edge.J.T
    values, vectors = eigh(covariance, before)
    known = values < 1.0
    if not known.any():
        return None
    square = float(np.sum((vectors[:, known].T @ residual) ** 2 / values[known]))
    return square, _sigmas(square, int(known.sum()))


def _sigmas(square: float, freedom: int) -> float:
    """Of a normal that strays so far as seldom; the root of chi-squared where that is too seldom for a number."""
    log_probability = float(chi2.logsf(square, freedom))
    return float(-ndtri_exp(log_probability - np.log(2))) if np.isfinite(log_probability) else square**0.5
