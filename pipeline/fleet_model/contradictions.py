"""Lines whose vehicles contradict each other: two groups, many outside, or a part that moved together.

No majority decides which group is right: such a line shares nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binom, chi2

from pipeline.fleet_model.evidence import LineEvidence, shifts_in_sigmas
from pipeline.fleet_model.line import FEWEST_VEHICLES, LineModel

__all__ = ["Contradiction", "Motion", "contradiction_of", "motion_of"]

# Share of the scatter that the best cut into two groups explains: 0.64 of Gaussian mounts, 0.75 of evenly spread ones,
# who exceed this line once in a thousand (simulated, 20 to 1,000 vehicles).
_TWO_GROUPS, _OF_FEW = 0.79, 3.2
_SMALLEST_GROUP = 0.1
_AS_SURE = 0.1  # of the information of the upper quartile
_MOST_OUTSIDE = 0.1  # of a line's vehicles, beside those that stand outside by chance
_BY_CHANCE = 1e-3
_SIGMAS = 4.0  # of the mean of all vehicles, 12 of which are looked at
_MOVED_SIGMAS = 3.0  # of a vehicle that is counted as moved


@dataclass(frozen=True)
class Contradiction:
    """Why a line shares nothing: kind, axis (place in the observations), vehicles of the smaller part."""

    kind: Literal["two groups", "many outside"]
    axis: int
    vehicles: int


@dataclass(frozen=True, eq=False)
class Motion:
    """How a line moved lately: not at all, as a whole (one event), or in part.

    Args:
        kind: whole = all vehicles by the same, part = some of them.
        axis: with the clearest motion; -1 without any.
        size: mean motion of all vehicles along it [rad or m].
        vehicles: that moved by more than 3 of their sigmas along any axis.
    """

    kind: Literal["none", "whole", "part"]
    axis: int
    size: float
    vehicles: int


def contradiction_of(evidence: LineEvidence, model: LineModel) -> Contradiction | None:
    """Two groups among the vehicles, or more vehicles outside of the line than a line has; None for a sound line."""
    N, M = evidence.value.shape[0], evidence.to_mount.shape[1]
    outside = int((model.weight <= 0).sum())
    if outside >= max(3, _MOST_OUTSIDE * N):
        axes = model.axis[model.weight <= 0]
        return Contradiction("many outside", int(np.bincount(axes).argmax()), outside)
    z, sure = _shifts(evidence, model)
    for k in range(M):
        own = sure[:, k] & ~evidence.remounted
        share, smaller = _two_groups(z[own, k])
        if share > _TWO_GROUPS + _OF_FEW / max(int(own.sum()), 1):
            return Contradiction("two groups", k, smaller)
    return None


def _shifts(evidence: LineEvidence, model: LineModel) -> tuple[np.ndarray, np.ndarray]:
    """Shifts along each axis from the line, and which vehicles are about as sure of them as most."""
    A, M = evidence.to_mount, len(model.variance)
    W = evidence.weights(A @ np.diag(model.variance) @ A.T)
    residual = evidence.value - A @ model.mean[:M] - evidence.to_bias @ model.mean[M:]
    size = np.einsum("om,nop,pm->nm", A, W, A, optimize=True)
    sure = (size > 0) & (size >= _AS_SURE * np.quantile(size, 0.75, axis=0))
    score = shifts_in_sigmas(W, residual, A, np.sqrt(np.diag(model.prior.mount)))
    return np.where(sure, score / np.sqrt(np.where(size > 0, size, 1.0)), 0.0), sure


def _two_groups(value: Float[np.ndarray, " N"]) -> tuple[float, int]:
    """Share of the scatter that the best cut into two explains, and the size of the smaller group."""
    N = len(value)
    least = max(1, int(np.ceil(_SMALLEST_GROUP * N)))
    if max(FEWEST_VEHICLES, 2 * least) > N:
        return 0.0, 0
    z = np.sort(value - value.mean())
    below = np.cumsum(z)[:-1]
    k = np.arange(1, N)
    between = below**2 * N / (k * (N - k))
    cut = least - 1 + int(np.argmax(between[least - 1 : N - least]))
    total = float((z**2).sum())
    return (float(between[cut]) / total if total > 0 else 0.0), int(min(k[cut], N - k[cut]))


def motion_of(
    change: Float[np.ndarray, "N M"], covariance: Float[np.ndarray, "N M M"], seen: Bool[np.ndarray, "N M"]
) -> Motion:
    """How a line moved, from each vehicle's last days against its days before.

    Args:
        change: of each vehicle between the two.
        covariance: of it, as its days scatter.
        seen: axes that both parts determine.
    """
    sigma = np.sqrt(np.einsum("nmm->nm", covariance))
    z = np.where(seen, change / sigma, 0.0)
    moved = np.abs(z) > _MOVED_SIGMAS
    count, vehicles = seen.sum(axis=0), int(moved.any(axis=1).sum())
    if count.max(initial=0) < FEWEST_VEHICLES:
        return Motion("none", -1, 0.0, vehicles)
    weight = np.where(seen, 1 / sigma**2, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = (weight * np.where(seen, change, 0.0)).sum(axis=0) / total
    rest = np.where(seen, (change - mean) / sigma, 0.0)
    apart = chi2.sf((np.clip(rest, -4.5, 4.5) ** 2).sum(axis=0), np.maximum(count - 1, 1))
    many = binom.sf(moved.sum(axis=0) - 1, count, 2.7e-3)
    surely = np.abs(mean) * np.sqrt(total)
    smallest = np.maximum(2, _SMALLEST_GROUP * count)
    part = (apart < _BY_CHANCE) & (many < _BY_CHANCE) & (moved.sum(axis=0) > smallest)
    if part.any():
        axis = int(np.argmax(np.where(part, moved.sum(axis=0), -1)))
        return Motion("part", axis, float(mean[axis]), int(moved[:, axis].sum()))
    if (surely > _SIGMAS).any():
        axis = int(np.argmax(surely))
        return Motion("whole", axis, float(mean[axis]), vehicles)
    return Motion("none", -1, 0.0, vehicles)
