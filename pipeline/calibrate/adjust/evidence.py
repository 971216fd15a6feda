"""Information of the data alone, from a pair's estimate that includes the prior.

An estimate combines data and prior. Summed over a graph, the prior would count once for every edge, so it is
removed along the directions in which estimate and prior differ: if the estimate has a share c of the prior's
variance, the data alone have 1/c - 1 of its information. Directions left at the prior have c = 1 and no
information; small c lose nothing to cancellation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

from pipeline.rig.changes import change_between, change_covariance, change_jacobian
from pipeline.rig.checks import Check
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.evidence import EDGE, EdgeEvidence
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["evidence_of"]

_NOTHING = 1 - 1e-6  # of the prior's variance: a direction with more is what the day left at the prior
_LEAST_SHARE = 1e-9
# Of a direction's variance: what frames err by alike is stated with it, and at least so much is noise.
_LEAST_NOISE = 0.01


def evidence_of(
    estimate: PairEstimate,
    edge: Edge,
    prior: Prior,
    clock_sigma_s: float,
    checks: Sequence[Check] = (),
) -> EdgeEvidence:
    """The estimate without its prior.

    Args:
        prior: that the estimate has in it.
        clock_sigma_s: of the time offset before the day.
        checks: that the estimate failed, and that matter.
    """
    information, gradient = np.zeros((7, 7)), np.zeros(7)
    information[:6, :6], gradient[:6], in_weights = _of_pose(estimate, prior)
    bias = dict(estimate.bias)
    bias[EDGE] = bias.get(EDGE, np.zeros((6, 6))) + in_weights
    information[6, 6], gradient[6] = _clock(estimate, clock_sigma_s)
    failed = list(checks)
    if estimate.disproved:
        failed.append(Check(estimate.disproved, disproves=True))
    return EdgeEvidence(
        edge,
        estimate.T,
        estimate.time_offset_s or 0.0,
        0.5 * (information + information.T),
        gradient,
        _by_name(bias, edge, estimate.T),
        estimate.frames_used,
        estimate.frames_rejected,
        tuple(dict.fromkeys(failed)),
        estimate.diagnostics,
        tuple(estimate.notes),
        parts=estimate.parts if estimate.observable.any() else None,
    )


def _of_pose(
    estimate: PairEstimate, prior: Prior
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"], Float[np.ndarray, "6 6"]]:
    """Information and gradient of the left perturbation without biases, and biases in the weights."""
    to_change = change_jacobian(estimate.T)
    before = prior.covariance(estimate.pair)
    added = sum(estimate.bias.values(), np.zeros((6, 6)))
    # Columns V with V' before V = 1 and V' after V = c: of V' x the data alone know the variance c / (1 - c).
    shares, directions = eigh(change_covariance(estimate.T, estimate.covariance - added), before)
    shown = shares < _NOTHING
    if not (shown & estimate.observable.any()).any():
        return np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    V, c = directions[:, shown], np.maximum(shares[shown], _LEAST_SHARE)
    within = np.zeros((6, 6)) if estimate.bias_in_weights is None else estimate.bias_in_weights
    # The prior took part in the estimate, also against these biases.
    to_data = (V / (1 - c)).T @ to_change
    biases = to_data @ within @ to_data.T
    W = V @ np.linalg.inv(_less(np.diag(c / (1 - c)), biases))
    # At the estimate data and prior pull alike: the data alone are best as far beyond it as the prior pulls back.
    beyond = c / (1 - c) * (V.T @ change_between(estimate.T, prior.of(estimate.pair)))
    back = np.linalg.solve(to_change, before @ V)
    return to_change.T @ W @ V.T @ to_change, -to_change.T @ W @ beyond, back @ biases @ back.T


def _less(variance: np.ndarray, biases: np.ndarray) -> np.ndarray:
    """A covariance without its biases: the noise, at least a share of the total."""
    values, vectors = eigh(biases, variance)
    root = variance @ vectors
    return (root * np.maximum(1 - values, _LEAST_NOISE)) @ root.T


def _clock(estimate: PairEstimate, clock_sigma_s: float) -> tuple[float, float]:
    """Information and gradient of the time offset; none if its sigma is the prior's."""
    dt_s, expected_s = estimate.time_offset_s, estimate.time_offset_prior_s
    sigma_s = estimate.time_offset_sigma_s
    if dt_s is None or sigma_s is None or expected_s is None or sigma_s >= _NOTHING * clock_sigma_s:
        return 0.0, 0.0
    return 1 / sigma_s**2 - 1 / clock_sigma_s**2, (dt_s - expected_s) / clock_sigma_s**2


def _by_name(bias: Mapping[str, np.ndarray], edge: Edge, T: np.ndarray) -> dict[str, np.ndarray]:
    """Biases by the sensor's name, each in its own sensor's axes; those of the edge stay in the parent's."""
    names = {EDGE: EDGE, edge.parent.kind: edge.parent.name, edge.child.kind: edge.child.name}
    to_child = adjoint(inverse(T))
    return {
        names[owner]: to_child @ B @ to_child.T if names[owner] == edge.child.name else B
        for owner, B in bias.items()
    }
