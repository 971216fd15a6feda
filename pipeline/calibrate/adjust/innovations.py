"""Innovation of each edge: its distance to all others, in sigmas.

An edge without a second path between its sensors is compared with the prior. Directions that neither the edge
nor the others know better than the prior are left out.
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
    """Chi-squared of the edge against others and prior, and the equivalent normal sigmas.

    None if edge and others together know no direction better than the prior.
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
    """Normal deviate of equal probability; the root of chi-squared if that is below the number range."""
    log_probability = float(chi2.logsf(square, freedom))
    return float(-ndtri_exp(log_probability - np.log(2))) if np.isfinite(log_probability) else square**0.5
