"""Many control charts at once: did a value change at any split of its days, seen through the noise that days have.

The statistic is the largest difference between the days after and before a split, in units of its sigma (the
likelihood ratio of one step against none, Hinkley 1970, Biometrika 57(1)). Three things that real days do are part of
it: successive days err alike (AR(1), `autocorrelation`), a vehicle's days scatter more than they say (`scale`, known
to `freedom` degrees of freedom), and single days are far off (`clipped`). All arrays have a row per chart and a column
per day; a chart's days stand at the left, what is beyond its `count` weighs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import brentq
from scipy.special import owens_t
from scipy.stats import norm
from scipy.stats import t as student_t

__all__ = ["Charts", "Scan", "alarm_threshold", "clipped", "scan", "thresholds"]

# Sigmas by which a day may lie from the median of itself and its neighbours. Two days in a row are believed, one is
# not: with it, RED false alarms of days that err like Student's t with 4 degrees of freedom are those of normal ones.
_CLIP_SIGMAS = 3.0
_MOST_FREEDOM = 200  # beyond which Student's t is the normal distribution for our purpose


@dataclass(frozen=True, eq=False)
class Charts:
    """Day estimates of one degree of freedom each.

    Args:
        day: ordinals of the calendar, rising along a row; a fixed reference stands first, as if it were one day.
        value: estimates [rad or m], relative to any fixed value.
        sigma: what varies from day to day; infinite beyond `count`.
        accepted: False for days that were held.
        reference_days: days that the first column of a row stands for where it is a fixed reference (its sigma is that
            of their mean if they were independent), which is never clipped; 0 where it is a day like the others.
        count: days of each row.
    """

    day: Int[np.ndarray, "M N"]
    value: Float[np.ndarray, "M N"]
    sigma: Float[np.ndarray, "M N"]
    accepted: Bool[np.ndarray, "M N"]
    reference_days: Int[np.ndarray, " M"]
    count: Int[np.ndarray, " M"]

    @property
    def has_reference(self) -> Bool[np.ndarray, " M"]:
        """Rows whose first column is a fixed reference."""
        return self.reference_days > 0

    def row(self, m: int, first: int = 0, end: int | None = None) -> Charts:
        """One chart alone, or the part of its days from column `first` to before `end`."""
        end = int(self.count[m]) if end is None else end
        part = (slice(m, m + 1), slice(first, end))
        return Charts(
            self.day[part],
            self.value[part],
            self.sigma[part],
            self.accepted[part],
            self.reference_days[m : m + 1] * (first == 0),
            np.array([end - first]),
        )


@dataclass(frozen=True, eq=False)
class Scan:
    """Every split of every chart: split s lies between columns s and s + 1. Sigma is infinite where there is none."""

    size: Float[np.ndarray, "M S"]
    sigma: Float[np.ndarray, "M S"]

    @property
    def z(self) -> Float[np.ndarray, "M S"]:
        """Sizes in units of their sigmas."""
        return self.size / self.sigma


def clipped(charts: Charts, scale: Float[np.ndarray, " M"]) -> Float[np.ndarray, "M N"]:
    """Values, none further than some sigmas from the median of itself and its neighbours (at an end: of three)."""
    M, N = charts.value.shape
    out = charts.value.copy()
    if N < 3:
        return out
    rows, last = np.arange(M), charts.count - 1
    median = np.empty_like(out)
    a, b, c = out[:, :-2], out[:, 1:-1], out[:, 2:]
    median[:, 1:-1] = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    median[:, 0] = median[:, 1]
    median[rows, last] = median[rows, np.maximum(last - 1, 0)]
    # A reference is worth many days: the day after it stands beside it, not against it.
    second = charts.has_reference & (charts.count > 3)
    median[second, 1] = median[second, 2]
    reach = _CLIP_SIGMAS * scale[:, None] * np.where(np.isfinite(charts.sigma), charts.sigma, 0.0)
    moved = np.clip(out, median - reach, median + reach)
    many = (charts.count >= 3)[:, None] & (np.arange(N) < charts.count[:, None])
    many[:, 0] &= ~charts.has_reference
    return np.where(many, moved, out)


def scan(
    charts: Charts,
    value: Float[np.ndarray, "M N"],
    scale: Float[np.ndarray, " M"],
    autocorrelation: Float[np.ndarray, " M"],
) -> Scan:
    """Mean after minus mean before, at every split.

    Each side's variance counts that its days err alike; that both sides do so too would make the difference surer, and
    is left out: where the autocorrelation is overstated, that would be wrong the other way.

    Args:
        charts: the days.
        value: theirs, clipped or not.
        scale: factor on the sigmas.
        autocorrelation: of days that follow each other; it falls with the power of the days between.
    """
    a = 1 / charts.sigma
    held = charts.has_reference
    if held.any():
        a[held, 0] /= np.sqrt(_alike(charts.reference_days[held], autocorrelation[held]))
    weight = a * a
    total, moment = np.cumsum(weight, axis=1), np.cumsum(weight * value, axis=1)
    gap = np.diff(charts.day, axis=1).clip(min=0)
    rho = autocorrelation[:, None] ** gap
    before = _sum_variance(a, rho)[:, :-1]
    after = _sum_variance(a[:, ::-1], rho[:, ::-1])[:, ::-1][:, 1:]
    left, right = total[:, :-1], total[:, -1:] - total[:, :-1]
    there = np.arange(1, a.shape[1]) < charts.count[:, None]
    left, right = np.where(there, left, 1.0), np.where(there, right, 1.0)
    size = (moment[:, -1:] - moment[:, :-1]) / right - moment[:, :-1] / left
    sigma = scale[:, None] * np.sqrt(before / left**2 + after / right**2)
    return Scan(np.where(there, size, 0.0), np.where(there, sigma, np.inf))


def _alike(days: Int[np.ndarray, " M"], autocorrelation: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Variance of a mean of AR(1) days in that of independent ones."""
    lag = np.arange(1, days.max(initial=1))
    share = np.maximum(1 - lag / days[:, None], 0.0)
    return np.asarray(1 + 2 * (share * autocorrelation[:, None] ** lag).sum(axis=1))


def _sum_variance(a: np.ndarray, rho: np.ndarray) -> np.ndarray:
    """Variance of the running sum of `a e`, e of variance 1 with correlation rho from one to the next."""
    out = np.empty_like(a)
    carried, out[:, 0] = a[:, 0].copy(), a[:, 0] ** 2
    for k in range(1, a.shape[1]):
        carried *= rho[:, k - 1]
        out[:, k] = out[:, k - 1] + a[:, k] * (2 * carried + a[:, k])
        carried += a[:, k]
    return out


def thresholds(
    count: Int[np.ndarray, " M"], freedom: Float[np.ndarray, " M"], probability: Float[np.ndarray, " M"]
) -> Float[np.ndarray, " M"]:
    """Threshold on max |z| of each chart; infinite where there are fewer than two days.

    Args:
        count: days.
        freedom: degrees of freedom that the scale is known to.
        probability: of an alarm without a change.
    """
    keys = np.stack([count, np.clip(np.rint(freedom), 1, _MOST_FREEDOM), probability], axis=1)
    unique, index = np.unique(keys, axis=0, return_inverse=True)
    found = [_threshold(int(n), int(f), float(p)) if n > 1 else np.inf for n, f, p in unique]
    return np.array(found)[index.ravel()]


@lru_cache(maxsize=4096)
def _threshold(count: int, freedom: int, probability: float) -> float:
    # As many independent splits as the bound for known sigmas says, each with Student's t: the scale is not known.
    one = norm.sf(alarm_threshold(np.ones(count), probability))
    return float(student_t.isf(one, freedom))


def alarm_threshold(sigma: Float[np.ndarray, " N"], false_alarm_probability: float) -> float:
    """Threshold on max |z| that a chart of independent normal days exceeds with at most this probability.

    P(max > h) <= P(|z_1| > h) + sum P(|z_s-1| <= h < |z_s|): the first split above h is either the first of
    all or follows one below h. Neighbouring splits share their days, so the second terms are small; they
    are exact for the known correlation through Owen's T function: P(X > h >= Y) = 2 T(h, sqrt((1 - r)/(1 +
    r))) for r >= 0.

    Source: the upcrossing bound as in Worsley 1983, Biometrika 70(2) 455-464 (his Bonferroni improvement).

    Raises:
        ValueError: fewer than two days, or a probability outside (0, 1).
    """
    if len(sigma) < 2 or not 0 < false_alarm_probability < 1:
        raise ValueError(f"no threshold for {len(sigma)} days at probability {false_alarm_probability}")
    weight = np.cumsum(sigma**-2.0)
    before, after = weight[:-1], weight[-1] - weight[:-1]
    r = np.sqrt(before[:-1] * after[1:] / (before[1:] * after[:-1]))
    slope = np.sqrt((1 - r) / (1 + r))

    def excess(h: float) -> float:
        return 2 * norm.sf(h) + 4 * owens_t(h, slope).sum() - false_alarm_probability

    # 2 sf(h) alone bounds from below, Bonferroni over all splits from above.
    low = norm.isf(false_alarm_probability / 2)
    high = norm.isf(false_alarm_probability / (2 * len(sigma)))
    return float(brentq(excess, low - 1e-9, high + 1e-9)) if len(r) else float(low)
