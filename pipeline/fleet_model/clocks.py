"""Time offset of an edge over the vehicles of a model line: mean, scatter, steps of all, and who differs.

Random effects: offset of vehicle i ~ N(mean, scatter^2), known to sigma_i. The scatter is Paule and Mandel's (1982,
J. Res. Natl. Bur. Stand. 87): the one with which the vehicles lie as far apart as their sigmas say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq

from pipeline.fleet_model.line import FEWEST_VEHICLES, OUTSIDE

__all__ = ["LineClock", "clock_step", "line_clock", "of_vehicles"]

_RECENT_DAYS = 3
_ROUNDS = 5
_STEP_SIGMAS, _OF_ALL = 4.5, 0.8  # of a step of the line, and the share of vehicles that must show its sign


@dataclass(frozen=True, eq=False)
class LineClock:
    """Offsets of N vehicles [s].

    Args:
        mean: of the line, known to `sigma`.
        scatter: of vehicles about it.
        distance: of each vehicle from it, in sigmas.
    """

    mean: float
    sigma: float
    scatter: float
    distance: Float[np.ndarray, " N"]


def of_vehicles(
    vehicle: Int[np.ndarray, " D"], value: Float[np.ndarray, " D"], sigma: Float[np.ndarray, " D"]
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Vehicles, and each one's mean offset and its sigma. What its days err by alike is part of the line's scatter."""
    names, of = np.unique(vehicle, return_inverse=True)
    weight = 1 / sigma**2
    total, days = np.bincount(of, weight), np.bincount(of)
    mean = np.bincount(of, weight * value) / total
    off = np.bincount(of, weight * (value - mean[of]) ** 2)
    wider = np.maximum(off / np.maximum(days - 1, 1), 1.0)
    return names, mean, np.sqrt(wider / total)


def line_clock(value: Float[np.ndarray, " N"], sigma: Float[np.ndarray, " N"]) -> LineClock | None:
    """Mean and scatter of a line without the vehicles outside of it; None with too few vehicles."""
    if len(value) < FEWEST_VEHICLES:
        return None
    middle = np.median(value)
    spread = 1.4826 * np.median(np.abs(value - middle))
    kept = np.abs(value - middle) < OUTSIDE * np.hypot(sigma, spread)
    for _ in range(_ROUNDS):
        square = _paule_mandel(value[kept], sigma[kept])
        weight = 1 / (sigma[kept] ** 2 + square)
        mean = float((weight * value[kept]).sum() / weight.sum())
        distance = np.abs(value - mean) / np.sqrt(sigma**2 + square + 1 / weight.sum())
        inside = distance < OUTSIDE
        if (inside == kept).all() or inside.sum() < FEWEST_VEHICLES:
            break
        kept = inside
    return LineClock(mean, float(weight.sum() ** -0.5), float(np.sqrt(square)), distance)


def _paule_mandel(value: Float[np.ndarray, " N"], sigma: Float[np.ndarray, " N"]) -> float:
    def beyond(square: float) -> float:
        weight = 1 / (sigma**2 + square)
        mean = (weight * value).sum() / weight.sum()
        return float((weight * (value - mean) ** 2).sum() - (len(value) - 1))

    if beyond(0.0) <= 0:
        return 0.0
    most = float(np.ptp(value) ** 2) + float((sigma**2).max())
    return float(brentq(beyond, 0.0, most))


def clock_step(
    vehicle: Int[np.ndarray, " D"],
    day: Int[np.ndarray, " D"],
    value: Float[np.ndarray, " D"],
    sigma: Float[np.ndarray, " D"],
) -> tuple[float, float] | None:
    """Step of all offsets in the last days [s] and its sigma, as of a software release; None if there is none."""
    lately = day > day.max(initial=0) - _RECENT_DAYS
    if not lately.any() or lately.all():
        return None
    (before, b, b_sigma), (after, a, a_sigma) = (
        of_vehicles(vehicle[part], value[part], sigma[part]) for part in (~lately, lately)
    )
    _, i, j = np.intersect1d(before, after, return_indices=True)
    change = a[j] - b[i]
    found = line_clock(change, np.hypot(b_sigma[i], a_sigma[j]))
    if found is None or abs(found.mean) < _STEP_SIGMAS * found.sigma:
        return None
    alike = float(np.mean(np.sign(change) == np.sign(found.mean)))
    return (found.mean, found.sigma) if alike >= _OF_ALL else None
