"""Verdict of one chart tonight: whether its value differs from the reference, and since when.

A chart without a change needs no further analysis. A chart with a change is cut into levels, and the last
level is compared with the first. If the value returned (a repair without a service event), there is no change
any more. If it did not, the chart stays RED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.audit.changes import Change, Levels, clearest, describe, levels_of
from pipeline.audit.charts import Charts, clipped, thresholds
from pipeline.audit.days import FEWEST_DAYS
from pipeline.audit.noise import Noise
from pipeline.audit.reasons import REASONS, because
from pipeline.audit.scan import Scan, scan_by
from schemas.calibrations import DOF_NAMES

__all__ = ["ChartVerdict", "judge_charts"]

_VISIBLE_SIGMAS = 2.0  # a chart shows a change that is at least this many sigmas of its best-placed split
# RED: a change larger than the limit with a probability of 95 %.
_SURELY = 1.645
# Degrees of freedom of a scale that is as good as known: where a person only looks again, what it lacks is not counted
# for a chart with enough days to estimate their scatter. With fewer it is: their scatter is assumed.
_KNOWN = 240.0
_HEAVY = 2 / 3  # of the sigmas that one day may lie off, where single days are often far off
_TAIL = 4.0  # power by which days far off fall with the distance: Student's t with four degrees of freedom
_TAME = 2  # days in a row that are no chance where single days are seldom far off
_OPEN = tuple(REASONS[name] for name in ("one day", "few days", "maybe"))  # one day more may decide


@dataclass(frozen=True)
class ChartVerdict:
    """Verdict of one chart; `change` is None without an alarm."""

    status: str
    reason: str
    days_used: int
    statistic: float | None
    threshold: float | None
    change: Change | None
    days_needed: int | None = None  # accepted days that it lacks for a verdict, at least; None: it has one


@dataclass(frozen=True, eq=False)
class _Judged:
    """Clipped values of all charts, their scan, and numbers by chart."""

    charts: Charts
    value: np.ndarray
    noise: Noise
    limit: np.ndarray
    scan: Scan
    statistic: np.ndarray
    threshold: np.ndarray
    watch: np.ndarray  # beyond which a step may have been, and a drift begun
    believed: np.ndarray  # days in a row that are no chance
    visible: np.ndarray
    last_day: np.ndarray  # sigmas by which the last day stands out
    alone: np.ndarray  # beyond which one does where single days are as far off as they are
    last_size: np.ndarray
    baseline_days: int


def judge_charts(
    charts: Charts,
    noise: Noise,
    limit: Float[np.ndarray, " M"],
    probability: Float[np.ndarray, "2 M"],
    baseline_days: int,
) -> list[ChartVerdict]:
    """Judge every chart.

    Args:
        charts: day estimates, in order of edge and DoF.
        limit: size of a change that matters [rad or m].
        probability: false-alarm probabilities of each chart: of an alarm tonight, and of a change that may
        have begun.
        baseline_days: a chart without an alarm has no verdict until it has one more day than this.

    Returns:
        RED: a lasting change larger than `limit` with 95 % probability. YELLOW: a smaller change, one
            supported by a single day, or one that may have begun. GREEN: no change, and one of size `limit`
            would be detected. UNKNOWN: too few days, or sigmas too large to detect one.
    """
    if not len(charts.count):
        return []
    value = clipped(charts, noise.scale * np.where(noise.heavy, _HEAVY, 1.0))
    found = scan_by(charts, value, noise, noise.reach)
    z = [np.abs(z).max(axis=1, initial=0.0) for z in (found.z, found.drift_z)]
    # Steps and drifts share the budget; of a chart that counts which is further beyond its own threshold.
    to_watch = np.where(charts.count < FEWEST_DAYS, noise.freedom, np.maximum(noise.freedom, _KNOWN))
    limits = [
        thresholds(charts.count, freedom, np.minimum(p, 0.5) / 2, noise.autocorrelation, of)
        for freedom, p in zip((noise.freedom, to_watch), probability, strict=True)
        for of in ("step", "drift")
    ]
    drifts = z[1] / limits[1] > z[0] / limits[0]
    last_day, last_size = _last_day(charts, noise)
    seen = _Judged(
        charts, value, noise, limit, found, np.where(drifts, z[1], z[0]),
        np.where(drifts, limits[1], limits[0]), np.stack(limits[2:]), np.where(noise.heavy, _TAME + 1, _TAME),
        _VISIBLE_SIGMAS * found.sigma.min(axis=1, initial=np.inf), last_day,
        np.maximum(np.where(drifts, limits[1], limits[0]), 3 * (noise.far / probability[1]) ** (1 / _TAIL)),
        last_size, baseline_days,
    )  # fmt: skip
    return [_verdict(seen, m) for m in range(len(charts.count))]


def _last_day(charts: Charts, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each chart's last day from the median of the two days before, in sigmas and in the chart's unit."""
    rows, last = np.arange(len(charts.count)), charts.count - 1
    at = [charts.value[rows, np.maximum(last - k, 0)] for k in range(3)]
    sigma = charts.sigma[rows, np.maximum(last, 0)] * noise.scale
    # With three days, the other two are compared with the middle one.
    nearest = np.where(np.abs(at[0] - at[1]) < np.abs(at[0] - at[2]), at[0] - at[1], at[0] - at[2])
    size = np.where(charts.count > 2, nearest, at[0] - at[1])
    size = np.where(charts.count > 1, size, 0.0)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(sigma), np.abs(size) / (np.sqrt(2) * sigma), 0.0), size


def _verdict(seen: _Judged, m: int) -> ChartVerdict:
    days = int(seen.charts.count[m])
    if days < 2:
        needed = max(seen.baseline_days + 1, 2)
        reason = because("few", days=_count(days), needed=needed)
        return ChartVerdict("UNKNOWN", reason, days, None, None, None, needed - days)
    levels = None
    if seen.statistic[m] > seen.threshold[m]:
        levels = levels_of(
            seen.charts.row(m), seen.value[m, :days], seen.noise.at(slice(m, m + 1)), float(seen.threshold[m])
        )
        changed = _changed(seen, m, levels)
        if changed is not None:
            return changed
    return _unchanged(seen, m, levels if levels is not None and levels.returned else None)


def _changed(seen: _Judged, m: int, levels: Levels) -> ChartVerdict | None:
    """Alarm of a chart whose last level differs from its first; else None."""
    if levels.statistic <= levels.threshold:
        return None
    change, limit = describe(levels), float(seen.limit[m])
    status, reason = "RED", REASONS["lasting"]
    # Before a change one more, because a chance outlier among the first days persists for weeks.
    more = seen.believed[m] > _TAME and not seen.charts.has_reference[m]
    if abs(change.size) < limit:
        status, reason = "YELLOW", REASONS["small"]
    elif (days := min(levels.days_before - int(more), levels.days_after)) < seen.believed[m]:
        status, reason = "YELLOW", REASONS["one day" if days < 2 else "few days"]
    elif abs(change.size) - _SURELY * change.size_sigma < limit:
        status, reason = "YELLOW", REASONS["maybe"]
    elif levels.doubtful_sides:
        # Held days agree by chance only within their enlarged sigmas, so two of them stand for an accepted one.
        reason = REASONS["lasting, held"]
    needed = 1 if reason in _OPEN else None
    days = int(seen.charts.count[m])
    return ChartVerdict(status, reason, days, levels.statistic, levels.threshold, change, needed)


def _unchanged(seen: _Judged, m: int, levels: Levels | None) -> ChartVerdict:
    """Verdict without an alarm: GREEN, or UNKNOWN with a reason."""
    days, limit, visible = int(seen.charts.count[m]), float(seen.limit[m]), float(seen.visible[m])
    statistic = float(seen.statistic[m])
    if levels is not None:
        statistic, visible = levels.statistic, _VISIBLE_SIGMAS * levels.sigma

    def judged(
        status: str, reason: str, needed: int | None = None, change: Change | None = None
    ) -> ChartVerdict:
        return ChartVerdict(status, reason, days, statistic, float(seen.threshold[m]), change, needed)

    if days > 2 and seen.last_day[m] > seen.alone[m] and abs(seen.last_size[m]) > limit:
        return _one_day(seen, m)
    if levels is None:
        after = 1 if seen.believed[m] == _TAME else int(seen.believed[m])
        begun = clearest(seen.scan.row(m, days), seen.charts.day[m, :days], limit, seen.watch[:, m], after)
        if begun is not None:
            return judged("YELLOW", REASONS["begun"], 1, begun)
    if days <= seen.baseline_days:
        needed = seen.baseline_days + 1
        return judged("UNKNOWN", because("few", days=_count(days), needed=needed), needed - days)
    if visible > limit:
        # The smallest visible change decreases with the square root of the days.
        needed = max(math.ceil(days * (visible / limit) ** 2) - days, 1)
        return judged(
            "UNKNOWN", _too_inaccurate(DOF_NAMES[m % len(DOF_NAMES)], visible, limit, needed), needed
        )
    return judged("GREEN", REASONS["same" if levels is None else "back"])


def _one_day(seen: _Judged, m: int) -> ChartVerdict:
    """Verdict for an outlying last day: the next day decides whether the change lasts."""
    charts, last = seen.charts, int(seen.charts.count[m]) - 1
    day = int(charts.day[m, last])
    sigma = float(charts.sigma[m, last] * seen.noise.scale[m] * np.sqrt(2))
    before = int(charts.day[m, last - 1]) + 1
    change = Change(day, before, day, "step", float(seen.last_size[m]), sigma, day)
    return ChartVerdict(
        "YELLOW", REASONS["one day"], last + 1, float(seen.last_day[m]), float(seen.threshold[m]), change, 1
    )


def _too_inaccurate(dof: str, visible: float, limit: float, needed: int) -> str:
    """Reason of a chart that would miss a change above its limit [rad or m]."""
    scale, unit = (180 / math.pi, "deg") if dof.startswith("r") else (1.0, "m")
    numbers = {"visible": f"{visible * scale:.2g} {unit}", "limit": f"{limit * scale:.2g} {unit}"}
    return because("hidden", **numbers, more=_count(needed, "more such "))


def _count(days: int, such: str = "") -> str:
    return f"{days} {such}day{'s' * (days != 1)}"
