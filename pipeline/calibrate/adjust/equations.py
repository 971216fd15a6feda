"""Normal equations of a rig: evidence of edges, and the prior of each sensor once, for all poses and clocks.

Unknowns are the left perturbations of T_reference_sensor [rad, m], six per sensor, then a clock [s] per
sensor, both in the prior's order, then six for every sensor whose edges share a bias, in sigmas of it. If a
bias were only added to the covariance, it would not lower the weight of its edges: an edge of .05 deg with a
bias of .25 deg then changed a yaw of .037 deg from another edge to .046 deg. A bias of one edge is part of
its noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh

from pipeline.calibrate.numerics.covariance import inverse_of_information
from pipeline.rig.estimates import EDGE, Check, EdgeEvidence, PairEstimate, Prior
from pipeline.rig.graph import Edge
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import (
    adjoint,
    change_between,
    change_covariance,
    change_jacobian,
    exp_se3,
    hat,
    inverse,
    log_se3,
)

__all__ = ["Equations", "LinearEdge", "Rig", "equations_at", "evidence_of", "left_jacobian_inverse"]


@dataclass(frozen=True, eq=False)
class Rig:
    """Poses and clocks of all sensors, and their prior.

    Args:
        prior: the prior, before the day.
        biased: sensors whose edges share a bias.
    """

    poses: Extrinsics
    prior: Extrinsics
    clock_sigma_s: float
    biased: tuple[str, ...]
    biases: np.ndarray

    @classmethod
    def at(cls, prior: Extrinsics, clock_sigma_s: float, evidence: Sequence[EdgeEvidence]) -> Rig:
        """The prior as a start, with zeros for the biases of this evidence."""
        biased = tuple(sorted({owner for e in evidence for owner in e.bias} - {EDGE}))
        return cls(prior, prior, clock_sigma_s, biased, np.zeros(6 * len(biased)))

    @property
    def unknowns(self) -> int:
        """Number of unknowns: six per sensor and its clock, without the reference's; six per bias."""
        return 7 * len(self.prior.order) + len(self.biases)

    @property
    def prior_covariance(self) -> Float[np.ndarray, "N N"]:
        """Covariance of all unknowns around the prior."""
        P = np.eye(self.unknowns)
        poses, moving = 6 * len(self.prior.order), 7 * len(self.prior.order)
        P[:poses, :poses] = self.prior.covariance
        P[poses:moving, poses:moving] *= self.clock_sigma_s**2
        return P

    def clock(self, name: str) -> int | None:
        """Index of a sensor's clock among the unknowns; None = the reference."""
        order = self.prior.order
        return None if name == self.prior.reference.name else 6 * len(order) + order.index(name)

    def moved(self, x: Float[np.ndarray, " N"]) -> Rig:
        """The rig after a step of all unknowns."""
        poses, order = self.poses, self.prior.order
        T = {n: exp_se3(x[6 * k : 6 * k + 6]) @ poses.T[n] for k, n in enumerate(order)}
        clocks = x[6 * len(order) : 7 * len(order)]
        dt_s = {n: poses.dt_s.get(n, 0.0) + float(clocks[k]) for k, n in enumerate(order)}
        kept = {poses.reference.name: poses.T[poses.reference.name]}
        biases = self.biases + x[7 * len(order) :]
        return replace(self, poses=replace(poses, T=kept | T, dt_s=dt_s), biases=biases)

    def from_prior(self) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N N"]]:
        """The rig as a perturbation of the prior, and its derivative by the unknowns."""
        order, J = self.prior.order, np.eye(self.unknowns)
        x = np.zeros(self.unknowns)
        for k, name in enumerate(order):
            at = slice(6 * k, 6 * k + 6)
            x[at] = log_se3(self.poses.T[name] @ inverse(self.prior.T[name]))
            J[at, at] = left_jacobian_inverse(x[at])
            x[6 * len(order) + k] = self.poses.dt_s.get(name, 0.0) - self.prior.dt_s.get(name, 0.0)
        x[7 * len(order) :] = self.biases
        return x, J


@dataclass(frozen=True, eq=False)
class LinearEdge:
    """An edge's cost at a rig: 1/2 (x + J d)' W (x + J d) - g' (x + J d), d being a step of all unknowns."""

    evidence: EdgeEvidence
    x: np.ndarray  # 7, where rig and biases have the edge, from where its evidence is linearised
    J: np.ndarray  # 7 N
    W: np.ndarray  # 7 7, of the edge with its own bias
    g: np.ndarray  # 7
    own: np.ndarray  # 7 6, one sigma of the edge's own bias, which W has in it

    @property
    def descent(self) -> Float[np.ndarray, " 7"]:
        """Gradient at the rig, downwards."""
        return np.asarray(self.g - self.W @ self.x)


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations H d = g of a rig, and their parts."""

    H: np.ndarray  # N N
    g: np.ndarray  # N
    prior_information: np.ndarray  # N N, its share in H
    edges: tuple[LinearEdge, ...]

    def without(self, left_out: LinearEdge) -> Equations:
        """The equations without one edge."""
        J, edges = left_out.J, tuple(e for e in self.edges if e is not left_out)
        return replace(self, H=self.H - J.T @ left_out.W @ J, g=self.g - J.T @ left_out.descent, edges=edges)

    def common(self, C: Float[np.ndarray, "N N"], rig: Rig) -> Float[np.ndarray, "N N"]:
        """Part of the solution's covariance C from errors common to all days: the prior's and the biases'."""
        alike = rig.prior_covariance
        poses = len(rig.prior.covariance)
        alike[:poses, :poses] = rig.prior.common
        follow = C @ self.prior_information
        of_edges = [C @ (e.J.T @ (e.W @ e.own)) for e in self.edges]
        return sum((K @ K.T for K in of_edges), follow @ alike @ follow.T)


def equations_at(rig: Rig, evidence: Sequence[EdgeEvidence]) -> Equations:
    """The normal equations of the prior and of these edges at a rig."""
    edges = tuple(_linear_edge(rig, e) for e in evidence)
    x, J = rig.from_prior()
    information = inverse_of_information(rig.prior_covariance)
    prior = J.T @ information @ J
    H = prior + sum((e.J.T @ e.W @ e.J for e in edges), np.zeros_like(prior))
    g = sum((e.J.T @ e.descent for e in edges), -J.T @ information @ x)
    return Equations(0.5 * (H + H.T), g, prior, edges)


def left_jacobian_inverse(xi: Float[np.ndarray, " 6"]) -> Float[np.ndarray, "6 6"]:
    """J with log(exp(d) exp(xi)) = xi + J d to first order; exact to 1e-9 for rotations below 0.3 rad.

    The series of Bernoulli's numbers (Sola, Deray, Atchuthan 2018, eq. 144, has it in closed form).
    """
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = hat(xi[:3])
    ad[3:, :3] = hat(xi[3:])
    square = ad @ ad
    return np.eye(6) - ad / 2 + square / 12 - square @ square / 720 + square @ square @ square / 30240


def _linear_edge(rig: Rig, evidence: EdgeEvidence) -> LinearEdge:
    parent, child = (s.name for s in evidence.edge.sensors)
    poses = rig.poses
    xi = log_se3(poses.between(parent, child) @ inverse(evidence.T))
    dt_s = poses.dt_s.get(child, 0.0) - poses.dt_s.get(parent, 0.0)
    J = np.zeros((7, rig.unknowns))
    J[:6, : 6 * len(poses.order)] = left_jacobian_inverse(xi) @ poses.jacobian_between(parent, child)
    for name, sign in ((parent, -1.0), (child, 1.0)):
        at = rig.clock(name)
        if at is not None:
            J[6, at] = sign
    x = np.append(xi, dt_s - evidence.dt_s)
    for owner, error in _shared(evidence).items():
        k = 6 * rig.biased.index(owner)
        J[:, 7 * len(poses.order) + k :][:, :6] = error
        x += error @ rig.biases[k : k + 6]
    return LinearEdge(evidence, x, J, *_with_own_bias(evidence))


def _with_own_bias(evidence: EdgeEvidence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information and gradient of an edge, with its own bias as part of the noise, and that bias's sigma (7 6)."""
    own = _rows_of_seven(_root(evidence.bias.get(EDGE, np.zeros((6, 6)))))
    # (W^-1 + B)^-1 = W (1 + B W)^-1, which also holds where W is singular; its minimum stays where it was.
    follow = np.linalg.inv(np.eye(7) + own @ own.T @ evidence.information)
    W = evidence.information @ follow
    return 0.5 * (W + W.T), follow.T @ evidence.gradient, own


def _shared(evidence: EdgeEvidence) -> dict[str, np.ndarray]:
    """Error of the edge (7 6) due to one sigma of a sensor's bias: an apparent rotation in the sensor's own axes."""
    parent, child = evidence.edge.sensors
    seen = {parent.name: -np.eye(6), child.name: adjoint(evidence.T)}
    return {n: _rows_of_seven(seen[n] @ _root(B)) for n, B in evidence.bias.items() if n != EDGE}


def _rows_of_seven(of_pose: np.ndarray) -> np.ndarray:
    """The matrix with a row of zeros for the clock."""
    return np.vstack([of_pose, np.zeros((1, 6))])


def _root(covariance: np.ndarray) -> np.ndarray:
    """Symmetric root, so that errors of edges with different sizes of the same bias remain fully correlated."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


# --------------------------------------------------------------------------------------------------
# Information of the data alone, from a pair's estimate that includes the prior.
#
# An estimate combines data and prior. Summed over a graph, the prior would count once for every edge, so it is
# removed along the directions in which estimate and prior differ: if the estimate has a share c of the prior's
# variance, the data alone have 1/c - 1 of its information. Directions left at the prior have c = 1 and no
# information; small c lose nothing to cancellation.

_NOTHING = 1 - 1e-6  # of the prior's variance: a direction with more is what the day left at the prior
_LEAST_SHARE = 1e-9
# Of a direction's variance: what frames err by alike is stated with it, and at least so much is noise.
_LEAST_NOISE = 0.01


def evidence_of(
    estimate: PairEstimate, edge: Edge, prior: Prior, clock_sigma_s: float, checks: Sequence[Check] = ()
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
        edge, estimate.T, estimate.time_offset_s or 0.0, 0.5 * (information + information.T), gradient,
        _by_name(bias, edge, estimate.T), estimate.frames_used, estimate.frames_rejected,
        tuple(dict.fromkeys(failed)), estimate.diagnostics, tuple(estimate.notes),
        parts=estimate.parts if estimate.observable.any() else None,
    )  # fmt: skip


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
