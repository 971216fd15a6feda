"""One chart cut into levels: times of change, sudden or slow, and sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from pipeline.audit.charts import Charts
from pipeline.audit.noise import Noise
from pipeline.audit.scan import Scan, scan_by

__all__ = ["Change", "Levels", "clearest", "describe", "levels_of", "start_interval"]

# Fall of twice the log-likelihood that bounds the start day's interval. A split is discrete, so the
# quantile of chi-squared is only a guide; with this value the interval held the true day in 97-99 % of
# simulated steps (tests/audit).
_START_DROP = 6.0
# Twice the log-likelihood by which a slow drift must beat a step: odds of 20.
_CLEAR_ODDS = 6.0
_BACK = 2.0  # sigmas from the fixed reference within which a level is where that was


@dataclass(frozen=True)
class Change:
    """One change: `day` is the first day with the new value; [earliest, latest] contains the true one with 95 %."""

    day: int
    earliest: int
    latest: int
    kind: str  # 'step' or 'slow drift'
    size: float
    size_sigma: float
    # First day of the level that it has tonight; between `day` and it lie others that are off too.
    settled: int = 0


@dataclass(frozen=True, eq=False)
class Levels:
    """Difference of a chart's last level from its first; for a chart without levels, the size of its drift.

    Args:
        value: clipped values of the chart, which has one row.
        whole: the scan of the whole chart.
        start: column at which it left the first level for good; 0 if it returned, or drifts.
        size: last level minus first level.
        threshold: on size over sigma.
        returned: True if the chart left the first level and the last level equals it again.
    """

    chart: Charts
    value: np.ndarray
    noise: Noise
    whole: Scan
    start: int
    size: float
    sigma: float
    threshold: float
    days_before: int
    days_after: int
    doubtful_sides: int
    returned: bool

    @property
    def statistic(self) -> float:
        """Size in sigmas."""
        return abs(self.size) / self.sigma


def levels_of(chart: Charts, value: Float[np.ndarray, " N"], noise: Noise, threshold: float) -> Levels:
    """Cut a chart (one row, clipped values) into levels that differ by `threshold` sigmas; compare last and first."""

    def split(first: int, end: int) -> int | None:
        part = scan_by(chart.row(0, np.arange(first, end)), value[None, first:end], noise)
        z = np.abs(part.z[0])
        return first + 1 + int(np.argmax(z)) if len(z) and z.max() > threshold else None

    N, whole = len(value), scan_by(chart, value[None], noise)
    edges = [0, *_cuts(0, N, split), N]
    # A single last day is no level yet: the one before it is still the current one.
    while len(edges) > 3 and edges[-1] - edges[-2] < 2:
        edges.pop(-2)
    spans = list(pairwise(edges))
    off = [_against(chart, value, spans[0], span, noise) for span in spans[1:]]
    differs = [abs(size) / sigma > threshold for size, sigma in off]
    returned = _where_the_reference_is(chart, value, spans, noise) if differs and differs[-1] else None
    if not off:
        s = int(np.argmax(np.abs(whole.drift_z[0])))
        spans, off = [(0, s + 1), (s + 1, N)], [(float(whole.drift[0, s]), float(whole.drift_sigma[0, s]))]
    size, sigma = off[-1] if returned is None else returned
    back = len(off) - 1
    while back > 0 and differs[back - 1]:
        back -= 1
    sides = (spans[0], spans[-1])
    accepted = [bool(chart.accepted[0, a:b].any()) for a, b in sides]
    days_before, days_after = (b - a for a, b in sides)
    if chart.has_reference[0]:
        days_before = max(days_before, int(chart.reference_days[0]))
    return Levels(
        chart, value, noise, whole, edges[back + 1] % N, size, sigma, threshold, days_before, days_after,
        2 - sum(accepted), returned is not None or (len(off) > 1 and not differs[-1]),
    )  # fmt: skip


def _where_the_reference_is(
    chart: Charts, value: np.ndarray, spans: Sequence[tuple[int, int]], noise: Noise
) -> tuple[float, float] | None:
    """Distance of a returned last level from the fixed reference alone, with its sigma.

    The first level may include a few outlying days, and then it differs from the reference.
    """
    if not chart.has_reference[0] or len(spans) < 2 or spans[0][1] < 2:
        return None
    size, sigma = _against(chart, value, (0, 1), spans[-1], noise)
    return (size, sigma) if abs(size) < _BACK * sigma else None


def describe(levels: Levels) -> Change:
    """Kind, start with its interval, and size of a chart's remaining change."""
    chart, whole, day = levels.chart, levels.whole, levels.chart.day[0]
    drift_gain = whole.drift_z[0] ** 2
    if not levels.start or drift_gain.max() > (whole.z[0] ** 2).max() + _CLEAR_ODDS:
        return _drift(whole, day, int(np.argmax(drift_gain)))
    # Of the splits, those about where the first level was left: a later change must not move it.
    end = levels.start + levels.days_after
    near = scan_by(chart.row(0, np.arange(end)), levels.value[None, :end], levels.noise)
    first, earliest, latest = start_interval(near.z[0] ** 2, day)
    if int(day[levels.start]) != first:
        first = int(day[levels.start])
        earliest, latest = min(earliest, int(day[levels.start - 1]) + 1), max(latest, first)
    settled = int(day[len(levels.value) - levels.days_after])
    return Change(first, earliest, latest, "step", levels.size, levels.sigma, settled)


def clearest(
    whole: Scan,
    day: Int[np.ndarray, " N"],
    limit: float,
    threshold: Float[np.ndarray, " 2"],
    days_after: int,
) -> Change | None:
    """The most significant step or drift above a size and a threshold; None if there is none.

    Args:
        limit: size of a change that matters [rad or m].
        threshold: on size over sigma, for a step and for a drift.
        days_after: minimum number of days since the change.
    """
    last = len(day) - days_after
    step, drift = (
        np.where((np.abs(size) > limit) & (np.abs(z) > beyond), np.abs(z), 0.0)[:last]
        for size, z, beyond in zip(
            (whole.size[0], whole.drift[0]), (whole.z[0], whole.drift_z[0]), threshold, strict=True
        )
    )
    if not max(step.max(initial=0.0), drift.max(initial=0.0)):
        return None
    if drift.max() ** 2 > step.max() ** 2 + _CLEAR_ODDS * (step.max() > 0):
        return _drift(whole, day, int(np.argmax(drift)))
    s = int(np.argmax(step))
    first = int(day[s + 1])
    _, earliest, latest = start_interval(whole.z[0] ** 2, day)
    earliest, latest = min(earliest, first), max(latest, first)
    return Change(first, earliest, latest, "step", float(whole.size[0, s]), float(whole.sigma[0, s]), first)


def _drift(whole: Scan, day: Int[np.ndarray, " N"], s: int) -> Change:
    size, sigma = float(whole.drift[0, s]), float(whole.drift_sigma[0, s])
    first, earliest, latest = start_interval(whole.drift_z[0] ** 2, day)
    return Change(first, earliest, latest, "slow drift", size, sigma)


def start_interval(gain: Float[np.ndarray, " S"], day: Int[np.ndarray, " N"]) -> tuple[int, int, int]:
    """First day with the new value, and its interval, from twice the log-likelihood gain of each split.

    Days without an estimate count: the change may lie anywhere after the last day before the earliest
    likely split.
    """
    best = int(np.argmax(gain))
    likely = np.flatnonzero(gain >= gain[best] - _START_DROP)
    return int(day[best + 1]), int(day[likely[0]]) + 1, int(day[likely[-1] + 1])


def _cuts(first: int, end: int, split: Callable[[int, int], int | None]) -> list[int]:
    """Columns at which the chart changes, by binary segmentation (Vostrikova 1981)."""
    at = split(first, end) if end - first > 1 else None
    if at is None:
        return []
    return [*_cuts(first, at, split), at, *_cuts(at, end, split)]


def _against(
    chart: Charts, value: np.ndarray, reference: tuple[int, int], level: tuple[int, int], noise: Noise
) -> tuple[float, float]:
    """Difference of two levels and its sigma."""
    columns = np.r_[slice(*reference), slice(*level)]
    found = scan_by(chart.row(0, columns), value[None, columns], noise)
    at = reference[1] - reference[0] - 1
    return float(found.size[0, at]), float(found.sigma[0, at])
