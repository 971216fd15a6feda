"""What one chart says tonight: is the value where it was when the reference was taken, and if not, since when.

A chart whose days hold no change is judged at a glance. One that does is cut into levels, and what counts is the last
of them against the first: a value that came back (a repair without a service event) is no change any more, one that
stayed off is RED for as long as it does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.audit.changes import Change, Levels, describe, levels_of
from pipeline.audit.charts import Charts, Scan, clipped, scan, thresholds
from pipeline.audit.noise import Noise

__all__ = ["ChartVerdict", "judge_charts"]

_VISIBLE_SIGMAS = 2.0  # a chart shows a change that is at least this many sigmas of its best-placed split
_SUSPECT_SIGMAS = 3.0  # from here to the alarm threshold a chart is neither green nor an alarm
_LASTING = "a lasting change of a size that matters"
_ONE_DAY = "one day stands out: the next day will tell whether it lasts"


@dataclass(frozen=True)
class ChartVerdict:
    """What one chart says; `change` is None where there is no alarm."""

    status: str
    reason: str
    days_used: int
    statistic: float | None
    threshold: float | None
    visible_size: float | None  # smallest change of a well-placed step that the chart would show [rad or m]
    change: Change | None


@dataclass(frozen=True, eq=False)
class _Judged:
    """Of all charts: clipped values, their scan, and numbers by chart."""

    charts: Charts
    value: np.ndarray
    noise: Noise
    limit: np.ndarray
    statistic: np.ndarray
    threshold: np.ndarray
    visible: np.ndarray
    suspect: np.ndarray
    last_day: np.ndarray  # sigmas by which the last day stands out
    last_size: np.ndarray
    baseline_days: int


def judge_charts(
    charts: Charts,
    noise: Noise,
    limit: Float[np.ndarray, " M"],
    probability: Float[np.ndarray, " M"],
    baseline_days: int,
) -> list[ChartVerdict]:
    """Judge every chart.

    Args:
        charts: day estimates.
        noise: how they scatter.
        limit: size of a change that matters [rad or m].
        probability: of an alarm of this chart in this audit where nothing changed.
        baseline_days: a chart says nothing, unless it alarms, until it has one day more than this.

    Returns:
        RED: a lasting change of at least `limit`. YELLOW: a smaller one, or one that rests on a single day.
        GREEN: no change, and one of size `limit` would be seen. UNKNOWN: too few days, or sigmas too large
            to see one.
    """
    if not len(charts.count):
        return []
    value = clipped(charts, noise.scale)
    found = scan(charts, value, noise.scale, noise.autocorrelation)
    threshold = thresholds(charts.count, noise.freedom, probability)
    last_day, last_size = _last_day(charts, noise)
    seen = _Judged(
        charts,
        value,
        noise,
        limit,
        np.abs(found.z).max(axis=1, initial=0.0),
        threshold,
        _VISIBLE_SIGMAS * found.sigma.min(axis=1, initial=np.inf),
        _suspect(found, limit),
        last_day,
        last_size,
        baseline_days,
    )
    return [_verdict(seen, m) for m in range(len(charts.count))]


def _suspect(found: Scan, limit: np.ndarray) -> np.ndarray:
    """Charts with a split that is neither sure enough for an alarm nor small enough to be ignored."""
    size = np.abs(found.size)
    return np.any((size > limit[:, None]) & (size > _SUSPECT_SIGMAS * found.sigma), axis=1)


def _last_day(charts: Charts, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """How far each chart's last day lies from the median of the two before it, in sigmas and in its unit."""
    rows, last = np.arange(len(charts.count)), charts.count - 1
    at = [charts.value[rows, np.maximum(last - k, 0)] for k in range(3)]
    sigma = charts.sigma[rows, np.maximum(last, 0)] * noise.scale
    # With three days, the middle one is what the other two are held against.
    nearest = np.where(np.abs(at[0] - at[1]) < np.abs(at[0] - at[2]), at[0] - at[1], at[0] - at[2])
    size = np.where(charts.count > 2, nearest, at[0] - at[1])
    size = np.where(charts.count > 1, size, 0.0)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(sigma), np.abs(size) / (np.sqrt(2) * sigma), 0.0), size


def _verdict(seen: _Judged, m: int) -> ChartVerdict:
    days = int(seen.charts.count[m])
    if days < 2:
        return ChartVerdict("UNKNOWN", f"{_count(days)} of data", days, None, None, None, None)
    if seen.statistic[m] > seen.threshold[m]:
        levels = levels_of(seen.charts.row(m), seen.value[m, :days], seen.noise, m, float(seen.threshold[m]))
        verdict = _changed(seen, m, levels)
        if verdict is not None:
            return verdict
        if levels.returned:
            return _unchanged(seen, m, levels)
    return _unchanged(seen, m, None)


def _changed(seen: _Judged, m: int, levels: Levels) -> ChartVerdict | None:
    """The alarm of a chart whose last level is not its first; None where it is."""
    if levels.statistic <= levels.threshold:
        return None
    change, limit = describe(levels), float(seen.limit[m])
    status, reason = "RED", _LASTING
    if abs(change.size) < limit:
        status, reason = "YELLOW", "a change below the size that matters"
    elif min(levels.days_before, levels.days_after) < 2:
        status, reason = "YELLOW", _ONE_DAY
    elif levels.doubtful_sides:
        # Held days agree by chance only within their enlarged sigmas, so two of them stand for an accepted one.
        reason = _LASTING + "; rests on days whose calibration was held"
    return ChartVerdict(
        status,
        reason,
        int(seen.charts.count[m]),
        levels.statistic,
        levels.threshold,
        float(seen.visible[m]),
        change,
    )


def _unchanged(seen: _Judged, m: int, levels: Levels | None) -> ChartVerdict:
    """No alarm: GREEN, or why not."""
    days, limit, visible = int(seen.charts.count[m]), float(seen.limit[m]), float(seen.visible[m])
    statistic, threshold = float(seen.statistic[m]), float(seen.threshold[m])
    if levels is not None:
        statistic, visible = levels.statistic, _VISIBLE_SIGMAS * levels.sigma

    def say(status: str, reason: str) -> ChartVerdict:
        return ChartVerdict(status, reason, days, statistic, threshold, visible, None)

    if days > 2 and seen.last_day[m] > threshold and abs(seen.last_size[m]) > limit:
        return _one_day(seen, m)
    if days <= seen.baseline_days:
        return say("UNKNOWN", f"{_count(days)} of data, {seen.baseline_days + 1} needed")
    if levels is None and seen.suspect[m]:
        return say("UNKNOWN", "a change may have begun, but it is not sure enough for an alarm")
    if visible > limit:
        return say("UNKNOWN", _what_could_hide(days, visible / limit))
    return say("GREEN", "no change" if levels is None else "back where the reference is")


def _one_day(seen: _Judged, m: int) -> ChartVerdict:
    """The last day stands alone: whether it lasts is not known before the next one."""
    charts, last = seen.charts, int(seen.charts.count[m]) - 1
    day = int(charts.day[m, last])
    sigma = float(charts.sigma[m, last] * seen.noise.scale[m] * np.sqrt(2))
    before = int(charts.day[m, last - 1]) + 1
    change = Change(day, before, day, "step", float(seen.last_size[m]), sigma, day)
    threshold, visible = float(seen.threshold[m]), float(seen.visible[m])
    return ChartVerdict("YELLOW", _ONE_DAY, last + 1, float(seen.last_day[m]), threshold, visible, change)


def _what_could_hide(days: int, times: float) -> str:
    """`times`: what a chart of so many days shows, in sizes that matter. It shrinks with the root of the days."""
    needed = math.ceil(days * times**2)
    return (
        f"no change seen, but one of the size that matters could hide: {times:.1f} times as much would show, and "
        f"that size after about {_count(needed)} like these"
    )


def _count(days: int) -> str:
    return "1 day" if days == 1 else f"{days} days"
