"""How days really scatter: by which factor more than they say, and how far the next day errs like the last.

Both come from medians of differences between days, which a few real changes do not move. What one vehicle shows is
drawn towards its fleet where it has few days, and the fleet towards what the false-alarm budget was proved for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from pipeline.audit.charts import Charts

__all__ = ["Noise", "estimate_noise"]

# Vehicles whose sigmas are wrong by a log-normal factor of 0.25: variances that a prior of 1 / (2 0.25^2) = 8 degrees
# of freedom describes.
_PRIOR_FREEDOM = 8.0
# Days that scatter more than this times what they say do not scatter: something moves, and is to be found. Four
# standard deviations of the log-normal factor above.
_MOST_SCALE = 3.0
_MEDIAN_EFFICIENCY = 0.37  # of the median of |normal| as an estimate of sigma (Rousseeuw & Croux 1993)
# What is assumed of a fleet that nobody has seen: the largest autocorrelation that the budget is proved for.
_PRIOR_AUTOCORRELATION = 0.6
_MOST_AUTOCORRELATION = 0.9
# Differences that weigh as much as the prior: one estimate from n of them is known to about 2.2 / sqrt(n), vehicles of
# a fleet differ by some 0.15.
_PRIOR_DIFFERENCES = 200.0


@dataclass(frozen=True, eq=False)
class Noise:
    """Of each chart: factor on its sigmas (>= 1), the degrees of freedom it is known to, and the autocorrelation."""

    scale: Float[np.ndarray, " M"]
    freedom: Float[np.ndarray, " M"]
    autocorrelation: Float[np.ndarray, " M"]


def estimate_noise(charts: Charts, dofs: int, edges: int) -> Noise:
    """Noise of all charts of a fleet.

    Args:
        charts: rows in order of vehicle, edge and degree of freedom; a chart without days has count 0.
        dofs: degrees of freedom of an edge.
        edges: that any vehicle has; those of the same name are of one kind of place on every vehicle.
    """
    shape = (len(charts.count) // (edges * dofs), edges, dofs)
    phi = np.repeat(_autocorrelation(charts, shape, _PRIOR_AUTOCORRELATION).ravel(), dofs)
    # Days that err alike differ less from each other than they scatter; that counts only as far as it was seen.
    alike = np.repeat(_autocorrelation(charts, shape, 0.0).ravel(), dofs)[:, None]
    size, gap, spread = _differences(charts, 1)
    expected = np.sqrt(np.maximum(spread[0] - 2 * alike**gap * spread[1], 1e-12 * spread[0]))
    sizes = (np.abs(size) / expected / norm.ppf(0.75)).reshape(*shape, -1)
    found, seen = _median(np.moveaxis(sizes, 0, 2).reshape(edges, dofs, -1))
    of_fleet = np.maximum(np.sqrt(_shrunk(found, seen, np.ones_like(found), _PRIOR_FREEDOM)[0]), 1.0)
    relative = sizes / of_fleet[None, :, :, None]
    vehicle, seen = _median(relative.reshape(len(relative), edges, -1))
    # Degrees of freedom of one edge share scenes: their differences count as those of one.
    variance, freedom = _shrunk(vehicle, seen / dofs, np.ones_like(vehicle), _PRIOR_FREEDOM)
    own, own_seen = _median(relative)
    prior = np.broadcast_to(variance[:, :, None], own.shape)
    own_variance, _ = _shrunk(own, own_seen, prior, np.broadcast_to(freedom[:, :, None], own.shape))
    scale = np.maximum(of_fleet[None] * np.sqrt(own_variance), 1.0)
    freedom = np.broadcast_to(freedom[:, :, None], scale.shape)
    return Noise(scale.ravel(), freedom.ravel().copy(), phi)


def _autocorrelation(charts: Charts, shape: tuple[int, ...], prior: float) -> Float[np.ndarray, "V P"]:
    """By vehicle and edge, from how much more two days differ that lie two days apart: by 1 + phi in variance."""
    logs, counts = [], []
    V, P = shape[:2]
    for lag in (1, 2):
        size, gap, spread = _differences(charts, lag)
        z = np.where(gap == lag, np.abs(size) / np.sqrt(spread[0]), np.nan).reshape(V, P, -1)
        of_fleet = _median(np.moveaxis(z, 0, 1).reshape(P, -1))
        of_vehicle = _median(z)
        logs.append((of_fleet[0], of_vehicle[0]))
        counts.append((of_fleet[1], of_vehicle[1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        fleet, vehicle = ((logs[1][k] / logs[0][k]) ** 2 - 1 for k in (0, 1))
    fleet = _drawn(fleet, np.minimum(counts[0][0], counts[1][0]), np.full(P, prior))
    seen = np.minimum(counts[0][1], counts[1][1])
    return _drawn(vehicle, seen, np.broadcast_to(fleet, vehicle.shape))


def _drawn(found: np.ndarray, seen: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Towards a prior, by how many differences were seen."""
    found = np.where(np.isfinite(found), found, prior)
    mean = (seen * found + _PRIOR_DIFFERENCES * prior) / (seen + _PRIOR_DIFFERENCES)
    return np.asarray(np.clip(mean, 0.0, _MOST_AUTOCORRELATION))


def _differences(charts: Charts, lag: int) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Differences of days `lag` columns apart (nan: none), days between, and sum and product of sigmas."""
    value, sigma, day = charts.value, np.where(np.isfinite(charts.sigma), charts.sigma, 1.0), charts.day
    there = np.arange(lag, value.shape[1]) < charts.count[:, None]
    first = np.broadcast_to(charts.has_reference[:, None], there.shape) & (np.arange(there.shape[1]) == 0)
    size = np.where(there & ~first, value[:, lag:] - value[:, :-lag], np.nan)
    spread = sigma[:, lag:] ** 2 + sigma[:, :-lag] ** 2, sigma[:, lag:] * sigma[:, :-lag]
    return size, (day[:, lag:] - day[:, :-lag]).clip(min=0), spread


def _median(values: Float[np.ndarray, "*rows N"]) -> tuple[np.ndarray, np.ndarray]:
    """Median of what is a number along the last axis (nan where nothing is), and how many numbers there are."""
    ordered = np.sort(values, axis=-1)  # nan comes last
    count = np.isfinite(values).sum(axis=-1)
    if ordered.shape[-1] == 0:
        return np.full(values.shape[:-1], np.nan), count
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], -1)[..., 0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, ordered.shape[-1] - 1)[..., None], -1)[..., 0]
    return np.where(count > 0, 0.5 * (low + high), np.nan), count


def _shrunk(
    size: np.ndarray, seen: np.ndarray, prior: np.ndarray, freedom: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Variance, drawn towards a prior one, and its degrees of freedom."""
    worth = np.where(np.isfinite(size), _MEDIAN_EFFICIENCY * seen, 0.0)
    size = np.where(np.isfinite(size), np.minimum(size, _MOST_SCALE), 0.0)
    return (freedom * prior + worth * size**2) / (freedom + worth), freedom + worth
