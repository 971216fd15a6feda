"""Differences between days of a fleet's charts, which show the scatter of days.

A few real changes do not affect them: variances are winsorised, spans over a jump and the newest days are
left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.audit.charts import Charts

__all__ = [
    "APART",
    "WINSOR",
    "Differences",
    "far_off",
    "leave_out_steps",
    "older_days",
    "winsorised_variance",
]

WINSOR = 2.0  # sigmas beyond which a difference counts as one of that size: a step is one of them
_WINSORED = 0.9205  # of the variance of a normal distribution that is left by that
# The newest days of a chart, a quarter of them at most, are judged by what older ones show: what begins on all
# vehicles at once is no scatter.
_NEWEST, _OLDER = 6, 4
# Lags [days] of the autocorrelation, beside neighbours: a working week has them.
APART = 3
# Share of a normal distribution beyond three sigmas, and the differences that it is worth.
_NORMAL, _FAR_WORTH = 0.0027, 400.0
_JUMP = 4.0  # sigmas of a difference that is no scatter
_TAKEN_BACK = 0.25  # share of a day's error that the next day lacks, at least: days err alike by 0.6


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of days `lag` columns apart on a chart (nan: none), days between them, and their sigmas."""

    lag: int
    size: Float[np.ndarray, "V P D S"]
    gap: Int[np.ndarray, "V P D S"]
    square: Float[np.ndarray, "V P D S"]
    product: Float[np.ndarray, "V P D S"]

    @classmethod
    def of(cls, charts: Charts, lag: int, shape: tuple[int, int, int]) -> Differences:
        """Differences of all charts of a fleet by vehicle, edge and degree of freedom, without the newest days."""
        sigma = np.where(np.isfinite(charts.sigma), charts.sigma, 1.0)
        there = np.arange(lag, sigma.shape[1]) < older_days(charts)[:, None]
        there[:, :1] &= ~charts.has_reference[:, None]
        a, b = (slice(None), slice(lag, None)), (slice(None), slice(None, -lag))
        size = np.where(there, charts.value[a] - charts.value[b], np.nan)
        parts = (
            size,
            (charts.day[a] - charts.day[b]).clip(min=0),
            sigma[a] ** 2 + sigma[b] ** 2,
            sigma[a] * sigma[b],
        )
        return cls(lag, *(part.reshape(*shape, -1) for part in parts))

    def at(self, vehicles: np.ndarray) -> Differences:
        """Differences of some vehicles."""
        return Differences(
            self.lag, self.size[vehicles], self.gap[vehicles], self.square[vehicles], self.product[vehicles]
        )

    def in_sigmas(self, phi: np.ndarray | float) -> Float[np.ndarray, "V P D S"]:
        """Differences in units of their sigmas for days with autocorrelation phi."""
        rho = np.asarray(phi)[..., None] ** self.gap
        return self.size / np.sqrt(np.maximum(self.square - 2 * rho * self.product, 1e-12 * self.square))


def older_days(charts: Charts) -> Int[np.ndarray, " M"]:
    """Number of older days of each chart.

    Their scatter is used to judge the newest days.
    """
    return np.asarray(charts.count - np.minimum(charts.count // _OLDER, _NEWEST))


def leave_out_steps(near: Differences, far: Differences) -> None:
    """Leave out spans over a jump: it is not scatter, and would increase the autocorrelation."""
    z = near.in_sigmas(0.0)
    sigma = np.sqrt(winsorised_variance(np.moveaxis(z, 0, 2).reshape(*z.shape[1:3], -1))[0])
    with np.errstate(invalid="ignore"):
        jump = np.abs(z) > _JUMP * sigma[None, :, :, None]
    near.size[jump] = np.nan
    spans = far.size.shape[-1]
    for k in range(APART):
        far.size[jump[..., k : k + spans]] = np.nan


def far_off(z: Float[np.ndarray, "V P D S"]) -> Float[np.ndarray, " P"]:
    """Share of an edge's differences beyond three sigmas, shrunk towards that of the normal distribution.

    A difference without an opposite neighbouring difference is a lasting change, not an outlying day.
    """
    sigma = np.sqrt(winsorised_variance(np.moveaxis(z, 0, 2).reshape(*z.shape[1:3], -1))[0])
    beside = np.pad(z, ((0, 0),) * 3 + ((1, 1),), constant_values=np.nan)
    with np.errstate(invalid="ignore"):
        taken = np.minimum(beside[..., :-2] * np.sign(z), beside[..., 2:] * np.sign(z))
        stays = taken > -_TAKEN_BACK * np.abs(z)  # not where there is none beside
        far = (~stays & (np.abs(z) > 3 * sigma[None, :, :, None])).sum(axis=(0, 2, 3))
    return np.asarray((far + _NORMAL * _FAR_WORTH) / (np.isfinite(z).sum(axis=(0, 2, 3)) + _FAR_WORTH))


def winsorised_variance(values: Float[np.ndarray, "*rows N"]) -> tuple[np.ndarray, np.ndarray]:
    """Winsorised variance about zero along the last axis (nan if empty), and the number of values."""
    size = np.abs(values)
    ordered = np.sort(size, axis=-1)  # nan comes last
    count = np.isfinite(values).sum(axis=-1)
    if ordered.shape[-1] == 0:
        return np.full(values.shape[:-1], np.nan), count
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], -1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, ordered.shape[-1] - 1)[..., None], -1)
    reach = WINSOR * 0.5 * (low + high) / 0.6745
    total = np.nansum(np.minimum(size, reach) ** 2, axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1) / _WINSORED, np.nan), count
