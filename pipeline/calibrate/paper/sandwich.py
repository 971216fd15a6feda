"""Covariance of a minimum of the paper's losses: block sandwich from curvature and the scatter of gradients.

The paper gives no uncertainty. The sandwich `H^-1 S H^-1` (H: curvature of the mean loss, S: scatter of the
gradients over blocks of frames that share a scene) is what resampling whole blocks converges to, at the price
of a few evaluations; its inverse is added to the prior's information. It does not include bias, and these
losses are biased (their minimum lies below the truth's value): a floor measured in simulation is added.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from pipeline.rig.se3 import exp_se3

__all__ = ["sandwich_covariance"]

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
