"""Size and day of an edge's change, in all six degrees of freedom at once, for days with correlated errors.

Generalised least squares with full covariances; `scan.py` does the same for one degree of freedom. If a day
has a larger sigma than most, the additional variance is independent of the other days. A fixed reference is
the mean of earlier days.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from pipeline.audit.days import DOFS, PairDays
from pipeline.audit.scan import alike
from pipeline.rig.attribution import PairShift
from pipeline.rig.changes import change_jacobian

__all__ = ["Whitened"]

_LEAST = 1e-6  # of what varies: the floor of a combination of DoF that a covariance takes for known


@dataclass(frozen=True, eq=False)
class Whitened:
    """Days of one edge, transformed so that all errors are independent with variance 1.

    `change` is whitened (6 N), from `origin`; `root` is the lower triangle of the covariance (6 N, 6 N).
    """

    days: Int[np.ndarray, " N"]
    origin: Float[np.ndarray, "4 4"]
    change: Float[np.ndarray, " X"]
    root: Float[np.ndarray, "X X"]

    @classmethod
    def of(
        cls,
        days: PairDays,
        autocorrelation: Float[np.ndarray, " 6"],
        wander: Float[np.ndarray, " 6"],
    ) -> Whitened:
        """Days whitened for this autocorrelation per axis and for a level that gains variance `wander` a day."""
        N, sigma = len(days.day), days.sigma
        correlation = days.spread / (sigma[:, :, None] * sigma[:, None, :])
        values, vectors = np.linalg.eigh(correlation)
        root = (vectors * np.sqrt(np.maximum(values, _LEAST))[:, None, :]) @ vectors.swapaxes(1, 2)
        root = sigma[:, :, None] * root
        share = np.minimum(1.0, np.median(np.median(sigma, axis=0) / sigma, axis=1))
        own = (1 - share**2)[:, None, None] * (root @ root.swapaxes(1, 2))
        if days.reference_days:
            many = np.array([days.reference_days])
            share[0], own[0] = 0.0, root[0] @ root[0].T * alike(many, autocorrelation.mean(keepdims=True))[0]
        root = share[:, None, None] * root
        gap = np.abs(days.day[:, None] - days.day)[:, :, None]
        covariance = np.einsum("iac,ijc,jbc->iajb", root, autocorrelation**gap, root)
        covariance[np.arange(N), :, np.arange(N)] += own
        since = days.day - days.day[0]
        covariance[:, range(DOFS), :, range(DOFS)] += wander[:, None, None] * np.minimum.outer(since, since)
        L = np.linalg.cholesky(covariance.reshape(DOFS * N, DOFS * N))
        return cls(days.day, days.origin, solve_triangular(L, days.change.ravel(), lower=True), L)

    def shift(self, shape: Float[np.ndarray, " N"], others: Sequence[Whitened] = ()) -> PairShift:
        """The change, from its share on each day: 0 before it, 1 once it is complete.

        `others` are alternative error models of the days; the largest of all their sigmas is returned.
        """
        X = self._designed(np.stack([np.ones(len(shape)), shape], axis=1))
        gain = np.linalg.solve(X.T @ X, X.T)[DOFS:]
        of_days = solve_triangular(self.root, gain.T, lower=True, trans="T").T
        unsure = [part @ part.T for part in (gain, *(of_days @ other.root for other in others))]
        covariance = max(unsure, key=lambda c: float(np.linalg.slogdet(c)[1]))
        to_twist = np.linalg.inv(change_jacobian(self.origin))
        return PairShift(self.origin, to_twist @ gain @ self.change, to_twist @ covariance @ to_twist.T)

    def step_gains(self) -> Float[np.ndarray, " S"]:
        """Twice the log-likelihood gain of a step at each split."""
        N = len(self.days)
        level, _ = np.linalg.qr(self._designed(np.ones((N, 1))))
        steps = self._designed(np.tri(N)[:, 1:])
        steps -= level @ (level.T @ steps)
        steps = steps.reshape(DOFS * N, N - 1, DOFS)
        left = self.change - level @ (level.T @ self.change)
        information = np.einsum("nsi,nsj->sij", steps, steps)
        moment = np.einsum("nsi,n->si", steps, left)
        return np.asarray(
            np.einsum("si,si->s", moment, np.linalg.solve(information, moment[..., None])[..., 0])
        )

    def _designed(self, columns: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "X Y"]:
        """Whitened design matrix of the changes given by each column's share, six degrees of freedom each."""
        return np.asarray(solve_triangular(self.root, np.kron(columns, np.eye(DOFS)), lower=True))
