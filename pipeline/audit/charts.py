"""Many control charts at once: test for a change at any split of the days, given their noise.

The statistic is the largest step or drift over all splits, in units of its sigma (`scan.py`; the likelihood
ratio of one change against none, Hinkley 1970, Biometrika 57(1)). It models three properties of real days:
errors of successive days are correlated (AR(1), `autocorrelation`), a vehicle's days scatter more than their
sigmas (`scale`, with `freedom` degrees of freedom), and single days are outliers (`clipped`). All arrays have
a row per chart and a column per day. A chart's days are at the left; columns from `count` on have no weight.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri, owens_t, stdtrit

__all__ = ["Charts", "alarm_threshold", "clipped", "thresholds"]

# Sigmas by which a day may lie from the median of itself and its neighbours. Two days in a row are believed, one is
# not: with it, RED false alarms of days that err like Student's t with 4 degrees of freedom are those of normal ones.
_CLIP_SIGMAS = 3.0
_MOST_FREEDOM = 240  # beyond which Student's t is the normal distribution for our purpose


@dataclass(frozen=True, eq=False)
class Charts:
    """Day estimates of one degree of freedom each.

    Args:
        day: calendar ordinals, increasing along a row; a fixed reference comes first, like a day.
        value: estimates [rad or m], relative to any fixed value.
        sigma: sigma of the part that varies from day to day; infinite beyond `count`.
        accepted: False for days that were held.
        reference_days: number of days in the fixed reference in the first column of a row; 0 if that column
            is an ordinary day. A reference has the sigma of the mean of independent days, and is never
            clipped.
        count: number of days of each row.
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

    def row(self, m: int, columns: Int[np.ndarray, " C"] | None = None) -> Charts:
        """One chart alone, with all of its days or those of some columns."""
        columns = np.arange(self.count[m]) if columns is None else columns
        part = slice(m, m + 1), columns
        reference_days = self.reference_days[[m]] * (columns[0] == 0)
        count = np.array([len(columns)])
        return Charts(
            self.day[part], self.value[part], self.sigma[part], self.accepted[part], reference_days, count
        )


def clipped(charts: Charts, scale: Float[np.ndarray, " M"]) -> Float[np.ndarray, "M N"]:
    """Values limited to some sigmas about the median of each value and its two neighbours."""
    M, N = charts.value.shape
    out = charts.value.copy()
    if N < 3:
        return out
    rows, last = np.arange(M), charts.count - 1
    median = out.copy()  # beyond a chart's days too: what memory held there could be no number
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


def thresholds(
    count: Int[np.ndarray, " M"],
    freedom: Float[np.ndarray, " M"],
    probability: Float[np.ndarray, " M"],
    autocorrelation: Float[np.ndarray, " M"],
    of: str,
) -> Float[np.ndarray, " M"]:
    """Threshold on max |z| of each chart; infinite for fewer than two days.

    Args:
        freedom: degrees of freedom of the scale.
        probability: of an alarm without a change.
        of: "step" or "drift"; drifts that start on neighbouring days are more correlated.
    """
    freedom = np.rint(_MOST_FREEDOM / np.rint(_MOST_FREEDOM / np.clip(freedom, 1, _MOST_FREEDOM)))
    keys = np.stack([count, freedom, probability, np.rint(10 * autocorrelation) / 10], axis=1)
    unique, index = np.unique(keys, axis=0, return_inverse=True)
    found = [_threshold(int(n), int(f), float(p), float(r), of) if n > 1 else np.inf for n, f, p, r in unique]
    return np.array(found)[index.ravel()]


@lru_cache(maxsize=16384)
def _threshold(count: int, freedom: int, probability: float, autocorrelation: float, of: str) -> float:
    # As many independent splits as in the bound for known sigmas, each with Student's t: the scale is unknown.
    one = ndtr(-alarm_threshold(np.ones(count), probability, autocorrelation, of))
    return float(-stdtrit(freedom, one))


def alarm_threshold(
    sigma: Float[np.ndarray, " N"],
    false_alarm_probability: float,
    autocorrelation: float = 0.0,
    of: str = "step",
) -> float:
    """Threshold on max |z| that a chart of normal days exceeds with at most this probability.

    P(max > h) <= P(|z_1| > h) + sum P(|z_s-1| <= h < |z_s|): the first split above h is either the first of
    all or follows one below h. Neighbouring splits share their days, so the second terms are small; they
    are exact for the known correlation through Owen's T function: P(X > h >= Y) = 2 T(h, sqrt((1 - r)/(1 +
    r))) for r >= 0. If errors of days are correlated, neighbouring splits share less.

    Source: the upcrossing bound as in Worsley 1983, Biometrika 70(2) 455-464 (his Bonferroni improvement).

    Raises:
        ValueError: fewer than two days, or a probability outside (0, 1).
    """
    if len(sigma) < 2 or not 0 < false_alarm_probability < 1:
        raise ValueError(f"no threshold for {len(sigma)} days at probability {false_alarm_probability}")
    r = _correlation(sigma, autocorrelation, of)
    slope = np.sqrt((1 - r) / (1 + r))

    def excess(h: float) -> float:
        return 2 * ndtr(-h) + 4 * owens_t(h, slope).sum() - false_alarm_probability

    # 2 sf(h) alone bounds from below, Bonferroni over all splits from above.
    low = -ndtri(false_alarm_probability / 2)
    high = -ndtri(false_alarm_probability / (2 * len(sigma)))
    return float(brentq(excess, low - 1e-9, high + 1e-9)) if len(r) else float(low)


def _correlation(sigma: Float[np.ndarray, " N"], autocorrelation: float, of: str) -> Float[np.ndarray, " R"]:
    """Correlation of the estimates of steps, or drifts, at neighbouring splits, at least 0."""
    lag = np.arange(len(sigma))[:, None] - np.arange(len(sigma))
    W = np.linalg.inv(autocorrelation ** np.abs(lag) * np.outer(sigma, sigma))
    # Column s: effect of a change after day s on each day.
    design = np.clip(lag, 0, 1 if of == "step" else None)[:, :-1].astype(np.float64)
    level = W.sum(axis=0)
    C = design.T @ (W - np.outer(level, level) / level.sum()) @ design
    return np.asarray(np.clip(np.diag(C, 1) / np.sqrt(np.diag(C)[:-1] * np.diag(C)[1:]), 0.0, 1.0))
