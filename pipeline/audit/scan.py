"""Test for a step or a drift at every split of a chart's days, with errors correlated from day to day.

The value of a day is a constant level, an error that is AR(1) from day to day, and independent errors of days:

    y_i = level_i + h_i u_i + e_i,   u_i = rho_i u_{i-1} + w_i,   rho_i = autocorrelation ** (days between)

The level itself may be a random walk (`wander`). A step changes the level between two days, a drift changes
its slope. Both are tested by their likelihood ratios against no change. One run of a Kalman filter and one of
its smoother cover all charts at once: a shock to a state at a split has the estimate `r / N` and the variance
`1 / N`, with the smoother's cumulants r and N (de Jong & Penzer 1998, J. Am. Stat. Assoc. 93(442)). This
equals generalised least squares: if errors of days are correlated, the day of a jump is the most informative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from pipeline.audit.charts import Charts
from pipeline.audit.noise import Noise

__all__ = ["SAME", "Scan", "alike", "errors_of", "scan", "scan_by"]

_FIRST = 3  # days that show a level: as many as are no chance where single days are often far off
SAME = 0.02  # autocorrelations that differ by less are equivalent


@dataclass(frozen=True, eq=False)
class Scan:
    """Every split of every chart: split s lies between columns s and s + 1. Sigma is infinite where there is none.

    Args:
        size: size of a step.
        sigma: its standard deviation.
        drift: size on the last day of a drift that starts at the split.
        drift_sigma: its standard deviation.
    """

    size: Float[np.ndarray, "M S"]
    sigma: Float[np.ndarray, "M S"]
    drift: Float[np.ndarray, "M S"]
    drift_sigma: Float[np.ndarray, "M S"]

    def row(self, m: int, days: int) -> Scan:
        """A Scan of one chart with this number of days."""
        at = slice(m, m + 1), slice(0, days - 1)
        return Scan(self.size[at], self.sigma[at], self.drift[at], self.drift_sigma[at])

    @property
    def z(self) -> Float[np.ndarray, "M S"]:
        """Steps in units of their sigmas."""
        return self.size / self.sigma

    @property
    def drift_z(self) -> Float[np.ndarray, "M S"]:
        """Drifts in units of their sigmas."""
        return self.drift / self.drift_sigma


def scan(
    charts: Charts,
    value: Float[np.ndarray, "M N"],
    scale: Float[np.ndarray, " M"],
    autocorrelation: Float[np.ndarray, " M"],
    wander: Float[np.ndarray, " M"] | None = None,
    reach: Float[np.ndarray, " M"] | None = None,
) -> Scan:
    """Steps and drifts at every split.

    If a day has a larger sigma than most days of its chart, the additional variance is taken as independent
    of the other days. A fixed reference is the mean of earlier days.

    Args:
        value: values of the charts' days, clipped or not.
        scale: factor on the sigmas.
        autocorrelation: correlation of errors on successive days, below 1; over n days it is its n-th power.
        wander: variance that the level gains per day; None = none.
        reach: limit of a day's innovation in sigmas, after a few days or a reference have shown the level;
            None = no limit. The rest is treated as an error of that day that decays as errors do. It then
            also explains the next days; only what it does not explain there adds to a step. Sizes are then
            too small.
    """
    h, own = errors_of(charts, autocorrelation)
    walk = (np.zeros(len(scale)) if wander is None else wander) / scale**2
    # A mean of days that wandered lies off the last of them by a third of what they wandered.
    own[:, 0] += walk * charts.reference_days / 3
    most = np.full(len(scale), np.inf) if reach is None else reach * scale
    first = np.where(charts.has_reference, 0, _FIRST)
    gap = np.diff(charts.day, axis=1).clip(min=0)
    rho = autocorrelation[:, None] ** gap
    out = np.zeros((4, len(gap), gap.shape[1]))
    out[1::2] = np.inf
    days = gap.astype(np.float64)
    _scan(np.ascontiguousarray(value), h, own, days, rho, walk, most, first, charts.count, scale, out)
    return Scan(*out)


def errors_of(
    charts: Charts, autocorrelation: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, "M N"]]:
    """Sigma that all days have in common, and the variance of each day's additional independent error."""
    held, known = charts.has_reference, np.isfinite(charts.sigma)
    known[:, 0] &= ~held
    ordered = np.sort(np.where(known, charts.sigma, np.inf), axis=1)
    usual = np.take_along_axis(ordered, np.maximum(known.sum(axis=1) - 1, 0)[:, None] // 2, 1)
    sigma = np.where(np.isfinite(charts.sigma), charts.sigma, 0.0)
    h = np.minimum(sigma, np.where(np.isfinite(usual), usual, 0.0))
    h[held, 0] = 0.0
    own = sigma**2 - h**2
    if held.any():
        own[held, 0] *= alike(charts.reference_days[held], autocorrelation[held])
    return h, own


def scan_by(
    charts: Charts,
    value: Float[np.ndarray, "M N"],
    noise: Noise,
    reach: Float[np.ndarray, " M"] | None = None,
) -> Scan:
    """Steps and drifts, each from the one of two autocorrelations that gives it the lower significance.

    If the autocorrelation is too high, one jump counts too much; if it is too low, a mean of many days does.
    """
    found = scan(charts, value, noise.scale, noise.autocorrelation, noise.wander, reach)
    other = noise.less_alike
    if other is None or not np.any(noise.autocorrelation - other.autocorrelation > SAME):
        return found
    less = scan(charts, value, other.scale, other.autocorrelation, other.wander, reach)
    step, slow = np.abs(less.z) < np.abs(found.z), np.abs(less.drift_z) < np.abs(found.drift_z)
    return Scan(
        np.where(step, less.size, found.size),
        np.maximum(less.sigma, found.sigma),
        np.where(slow, less.drift, found.drift),
        np.maximum(less.drift_sigma, found.drift_sigma),
    )


@no_type_check
@njit(cache=True)
def _scan(value, h, own, gap, rho, walk, reach, first, count, scale, out):  # noqa: ANN001, ANN202 (types by numba)
    """Fill `out` (size, sigma, drift, its sigma; chart; split): Kalman filter forward, smoother backward."""
    most = value.shape[1]
    surprise, weight, gain, slow_gain = (np.zeros(most), np.zeros(most), np.zeros(most), np.zeros(most))
    for m in range(len(value)):
        # Nothing is known of the level before the first day.
        level, u, p11, p13, p33 = value[m, 0], 0.0, own[m, 0] + h[m, 0] ** 2, -h[m, 0], 1.0
        for t in range(1, count[m]):
            r, k = rho[m, t - 1], h[m, t]
            u, p13, p33 = r * u, r * p13, r * r * (p33 - 1) + 1
            p11 += walk[m] * gap[m, t - 1]
            both, slow = p11 + k * p13, p13 + k * p33
            weight[t] = 1 / (both + k * slow + own[m, t])
            surprise[t] = value[m, t] - level - k * u
            if t > first[m]:
                far = reach[m] / np.sqrt(weight[t])
                beyond = surprise[t] - min(max(surprise[t], -far), far)
                surprise[t] -= beyond
                if k > 0:
                    u += beyond / k  # an innovation of u of any size, as the days of a heavy tail have
            gain[t], slow_gain[t] = both * weight[t], slow * weight[t]
            level, u = level + gain[t] * surprise[t], u + slow_gain[t] * surprise[t]
            p11, p13, p33 = p11 - gain[t] * both, p13 - gain[t] * slow, p33 - slow_gain[t] * slow
        r1 = r2 = r3 = n11 = n12 = n13 = n22 = n23 = n33 = grown = 0.0
        for t in range(count[m] - 1, 0, -1):
            # Through the day t: what it leaves of the level, its slope and u ...
            k, g1, g3 = h[m, t], gain[t], slow_gain[t]
            w1, w2, w3 = n11 * g1 + n13 * g3, n12 * g1 + n23 * g3, n13 * g1 + n33 * g3
            left, more = weight[t] * surprise[t] - g1 * r1 - g3 * r3, g1 * w1 + g3 * w3 + weight[t]
            r1, r3 = r1 + left, r3 + k * left
            n11, n12, n13 = n11 - 2 * w1 + more, n12 - w2, n13 - w3 - k * w1 + k * more
            n23, n33 = n23 - k * w2, n33 - 2 * k * w3 + k * k * more
            # ... and back over the days to the one before.
            days, r = gap[m, t - 1], rho[m, t - 1]
            grown += days
            r2, r3 = r2 + days * r1, r * r3
            n22 += days * days * n11 + 2 * days * n12
            if n11 > 0:
                out[0, m, t - 1], out[1, m, t - 1] = r1 / n11, scale[m] / np.sqrt(n11)
            if n22 > 0:
                out[2, m, t - 1], out[3, m, t - 1] = grown * r2 / n22, scale[m] * grown / np.sqrt(n22)
            n12, n13, n23, n33 = days * n11 + n12, r * n13, r * (days * n13 + n23), r * r * n33


def alike(days: Int[np.ndarray, " M"], autocorrelation: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Variance of the mean of `days` AR(1) days, divided by the variance of a mean of independent days."""
    lag = np.arange(1, days.max(initial=1))
    share = np.maximum(1 - lag / days[:, None], 0.0)
    return np.asarray(1 + 2 * (share * autocorrelation[:, None] ** lag).sum(axis=1))
