"""One chart cut into levels: where it changed, between which days, at once or slowly, by how much."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from pipeline.audit.charts import Charts, scan
from pipeline.audit.noise import Noise

__all__ = ["Change", "Levels", "describe", "levels_of", "ramp_fits", "start_interval"]

# Fall of twice the log-likelihood that bounds the start day's interval. A split is discrete, so the
# quantile of chi-squared is only a guide; with this value the interval held the true day in 97-99 % of
# simulated steps (tests/audit).
_START_DROP = 6.0
# Twice the log-likelihood by which a slow drift must beat a step: odds of 20.
_CLEAR_ODDS = 6.0


@dataclass(frozen=True)
class Change:
    """One change: `day` is the first with the new value; the true one is in [earliest, latest] with 95 %."""

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
    """The last level of a chart against its first.

    Args:
        chart: one row.
        value: its clipped values.
        scale: factor on its sigmas.
        start: column at which it left the first level for good; 0 where it is back there.
        size: last level less first.
        sigma: of the size.
        threshold: on size over sigma.
        returned: it had left the first level, and the last one is there again.
    """

    chart: Charts
    value: np.ndarray
    scale: float
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


def levels_of(
    chart: Charts, value: Float[np.ndarray, " N"], noise: Noise, m: int, threshold: float
) -> Levels:
    """Cut a chart into levels and hold the last against the first.

    Args:
        chart: one row.
        value: its clipped values.
        noise: of all charts.
        m: which of them this is.
        threshold: sigmas beyond which two levels differ.
    """
    scale, phi = noise.scale[m : m + 1], noise.autocorrelation[m : m + 1]

    def split(first: int, end: int) -> int | None:
        part = scan(chart.row(0, first, end), value[None, first:end], scale, phi)
        z = np.abs(part.z[0])
        return first + 1 + int(np.argmax(z)) if len(z) and z.max() > threshold else None

    cuts = _cuts(0, len(value), split)
    edges = [0, *cuts, len(value)]
    # A single last day is no level yet: the one before it is still the current one.
    while len(edges) > 3 and edges[-1] - edges[-2] < 2:
        edges.pop(-2)
    spans = list(pairwise(edges))
    off = [_against(chart, value, spans[0], span, scale, phi) for span in spans[1:]]
    size, sigma = off[-1]
    differs = [abs(s) / g > threshold for s, g in off]
    back = len(off) - 1
    while back > 0 and differs[back - 1]:
        back -= 1
    start = edges[back + 1]
    sides = (spans[0], spans[-1])
    accepted = [bool(chart.accepted[0, a:b].any()) for a, b in sides]
    days_before, days_after = (b - a for a, b in sides)
    if chart.has_reference[0]:
        days_before = max(days_before, 2)
    return Levels(
        chart, value, float(scale[0]), start, size, sigma, threshold, days_before, days_after,
        2 - sum(accepted), len(off) > 1 and not differs[-1],
    )  # fmt: skip


def describe(levels: Levels) -> Change:
    """Kind, start with its interval, and size of the change that a chart is left with."""
    chart, value, scale = levels.chart, levels.value, levels.scale
    sigma, day = chart.sigma[0] * scale, chart.day[0]
    step_gain = _step_gains(value, sigma)
    ramp_gain, ramp_size, ramp_sigma = ramp_fits(value, sigma, day)
    if np.max(ramp_gain) > np.max(step_gain) + _CLEAR_ODDS:
        s = int(np.argmax(ramp_gain))
        size, size_sigma = float(ramp_size[s]), float(ramp_sigma[s])
        return Change(*start_interval(ramp_gain, day), "slow drift", size, size_sigma)
    # Of the splits, those about where the first level was left: a later change must not move it.
    near = _step_gains(value[: levels.start + levels.days_after], sigma[: levels.start + levels.days_after])
    first, earliest, latest = start_interval(near, day)
    if int(day[levels.start]) != first:
        first = int(day[levels.start])
        earliest, latest = min(earliest, int(day[levels.start - 1]) + 1), max(latest, first)
    settled = int(day[len(value) - levels.days_after])
    return Change(first, earliest, latest, "step", levels.size, levels.sigma, settled)


def ramp_fits(
    value: Float[np.ndarray, " N"], sigma: Float[np.ndarray, " N"], day: Int[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Twice the log-likelihood gain, total size and sigma of a drift from each split on to the last day."""
    w = sigma**-2.0
    at = day.astype(np.float64)
    # A drift that sets in after day s-1 has grown by (day - day[s-1]): column s of the design.
    shape = np.maximum(at[None, :] - at[:-1, None], 0.0)
    shape /= shape[:, -1:]
    centred = shape - (shape @ w)[:, None] / w.sum()
    information = (centred**2) @ w
    size = (centred @ (w * value)) / information
    return size**2 * information, size, information**-0.5


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
    chart: Charts,
    value: np.ndarray,
    reference: tuple[int, int],
    level: tuple[int, int],
    scale: np.ndarray,
    phi: np.ndarray,
) -> tuple[float, float]:
    """Difference of two levels and its sigma, each with the variance that its own days have."""
    columns = np.r_[slice(*reference), slice(*level)]
    part = Charts(
        chart.day[:, columns],
        chart.value[:, columns],
        chart.sigma[:, columns],
        chart.accepted[:, columns],
        chart.reference_days,
        np.array([len(columns)]),
    )
    found = scan(part, value[None, columns], scale, phi)
    at = reference[1] - reference[0] - 1
    return float(found.size[0, at]), float(found.sigma[0, at])


def _step_gains(value: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Twice the log-likelihood gain of a step at each split, days taken as independent."""
    w = sigma**-2.0
    weight, moment = np.cumsum(w), np.cumsum(w * value)
    before, after = weight[:-1], weight[-1] - weight[:-1]
    size = (moment[-1] - moment[:-1]) / after - moment[:-1] / before
    return np.asarray(size**2 / (1 / before + 1 / after))
