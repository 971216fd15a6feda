"""The calibration that a vehicle should load tonight: one estimate from the accepted days since its last change.

Errors that vary from day to day average out, less so if they are correlated. Errors common to all days do not.

    x = sum_i G_i x_i,   G_i = (sum_j V_j^-1)^-1 V_i^-1,   covariance = f (sum_j V_j^-1)^-1 + sum_i G_i B_i

V_i is the varying part of the covariance, scaled by the vehicle's own scatter, B_i the common part, and f the
factor of AR(1) errors on the variance of a mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import exp_se3, inverse, log_se3

__all__ = ["DayEstimate", "State", "fuse"]

_MOST_SIGMAS = 4.0  # of one DoF, beyond which a day does not belong to the others and is left out


@dataclass(frozen=True, eq=False)
class DayEstimate:
    """One accepted day: T_parent_child, covariance (left perturbation), its common part, determined DoF.

    `common` None: the record does not have it. The whole covariance then counts as varying in the weights of
    days, and as common in the covariance of the result.
    """

    day: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 6"] | None
    observable: Bool[np.ndarray, " 6"]


@dataclass(frozen=True, eq=False)
class State:
    """The fused days: transform, covariance, its common part, DoF that at least one day determined, and the days."""

    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 6"]
    observable: Bool[np.ndarray, " 6"]
    days: tuple[str, ...]
    left_out: tuple[str, ...]


def fuse(
    days: Sequence[DayEstimate], *, scale: Float[np.ndarray, " 6"] | None = None, autocorrelation: float = 0.0
) -> State | None:
    """One estimate from several accepted days since the last change; None without days.

    `scale` is the ratio of the days' scatter to their sigmas by DoF of a change (rotation vector, shift of
    the child's origin); None = 1.
    """
    if not days:
        return None
    origin = days[0].T
    changes = log_se3(np.stack([d.T for d in days]) @ inverse(origin))
    spread = _varying(days)
    kept = _belonging(changes, spread, np.stack([d.observable for d in days]))
    own, x = [days[i] for i in kept], changes[kept]
    J = change_jacobian(origin)
    S = np.eye(6) if scale is None else np.linalg.solve(J, scale[:, None] * J)
    varying = S @ spread[kept] @ S.T
    information = np.linalg.inv(varying)
    total = np.linalg.inv(information.sum(axis=0))
    G = total @ information
    mean = np.einsum("nij,nj->i", G, x)
    shared = np.stack([d.covariance if d.common is None else d.common for d in own])
    common = _positive(np.einsum("nij,njk->ik", G, shared))
    lag = np.arange(1, len(own))
    alike = 1 + 2 * float(np.sum((1 - lag / len(own)) * autocorrelation**lag))
    said = all(d.common is not None for d in own)
    covariance = total * alike * said + common
    return State(
        exp_se3(mean) @ origin,
        0.5 * (covariance + covariance.T),
        common,
        np.any([d.observable for d in own], axis=0),
        tuple(d.day for d in own),
        tuple(d.day for i, d in enumerate(days) if i not in kept),
    )


def _belonging(
    x: Float[np.ndarray, "N 6"], varying: Float[np.ndarray, "N 6 6"], seen: Bool[np.ndarray, "N 6"]
) -> list[int]:
    """Days consistent with the median of all by their sigmas; all days if there are two."""
    if len(x) < 3:
        return list(range(len(x)))
    sigma = np.sqrt(np.einsum("nii->ni", varying))
    sigma = np.maximum(sigma, np.median(sigma, axis=0))
    median = np.array([np.median(x[seen[:, k], k]) if seen[:, k].any() else 0.0 for k in range(6)])
    spread = np.array(
        [np.median(np.abs(x[seen[:, k], k] - median[k])) if seen[:, k].any() else 0.0 for k in range(6)]
    )
    reach = _MOST_SIGMAS * np.maximum(sigma, 1.4826 * spread)
    far = (np.abs(x - median) > reach) & seen
    kept = [i for i in range(len(x)) if not far[i].any()]
    return kept or list(range(len(x)))


def _varying(days: Sequence[DayEstimate]) -> Float[np.ndarray, "N 6 6"]:
    """Varying part of the covariance; an undetermined DoF has all of it, hence no weight."""
    covariance = np.stack([d.covariance for d in days])
    varying = covariance - np.stack([np.zeros((6, 6)) if d.common is None else d.common for d in days])
    own, left = (np.einsum("nii->ni", matrices) for matrices in (covariance, varying))
    floor = 0.01 * own  # sigmas are estimates themselves
    seen = np.stack([d.observable for d in days])
    missing = np.where(seen, np.maximum(floor - left, 0.0), own)
    return varying + missing[:, :, None] * np.eye(6)


def _positive(matrix: np.ndarray) -> np.ndarray:
    """The nearest positive semidefinite matrix, in units in which the diagonal is 1."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-18))
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T) / np.outer(scale, scale))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(scale, scale))
