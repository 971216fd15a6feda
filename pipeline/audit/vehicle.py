"""All charts of one vehicle, judged together: one false-alarm budget, one start day, one moved sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.audit.attribution import Attribution, PairShift, attribute, independent_pairs, pair_shift
from pipeline.audit.charts import Change, Chart, ChartVerdict, judge_chart, start_interval
from pipeline.config import AuditConfig
from pipeline.geometry.changes import change_between, change_covariance
from schemas.calibrations import DOF_NAMES, PAIRS

__all__ = ["PairDays", "VehicleVerdict", "charts_of", "judge_vehicle", "limit_of"]


@dataclass(frozen=True, eq=False)
class PairDays:
    """Day estimates of one pair. Held days are among them: a large knock is just what the verdict holds.

    Args:
        day: ordinals of the calendar, rising.
        T: estimates of T_parent_child.
        covariance: theirs (left perturbation, rad and m).
        observable: per day and DoF; what a day did not determine is not on the charts.
        accepted: False for held days; their covariance is already enlarged.
    """

    day: np.ndarray
    T: np.ndarray
    covariance: np.ndarray
    observable: np.ndarray
    accepted: np.ndarray


@dataclass(frozen=True, eq=False)
class VehicleVerdict:
    """Verdicts by (pair, dof), and what moved; `attribution` is None where no chart alarms."""

    charts: dict[tuple[str, str], ChartVerdict]
    attribution: Attribution | None


def limit_of(pair: str, dof: str, config: AuditConfig) -> float:
    """Size of a change that matters [rad or m]."""
    if dof.startswith("t"):
        return config.translation_limit_m
    degrees = config.camera_lidar_limit_deg if pair == "camera_lidar" else config.radar_limit_deg
    return float(np.radians(degrees))


def charts_of(pair_days: PairDays) -> dict[str, Chart]:
    """Charts of a pair's DoFs, relative to its first day."""
    T, cov = pair_days.T, pair_days.covariance
    value = np.array([change_between(T[0], T_day) for T_day in T]).reshape(-1, 6)
    sigma = np.array(
        [np.sqrt(np.diag(change_covariance(t, c))) for t, c in zip(T, cov, strict=True)]
    ).reshape(-1, 6)
    charts = {}
    for k, dof in enumerate(DOF_NAMES):
        seen = pair_days.observable[:, k]
        charts[dof] = Chart(pair_days.day[seen], value[seen, k], sigma[seen, k], pair_days.accepted[seen])
    return charts


def judge_vehicle(
    pairs: Mapping[str, PairDays], scatter: Mapping[tuple[str, str], float], config: AuditConfig
) -> VehicleVerdict:
    """Judge all charts of a vehicle.

    Args:
        pairs: day estimates by pair; a pair may be missing.
        scatter: by (pair, dof), factor on the sigmas, see `pooled_scatter`.
        config: limits and the false-alarm budget.
    """
    charts = {(pair, dof): c for pair, days in pairs.items() for dof, c in charts_of(days).items()}
    live = sum(len(c.day) > 1 for c in charts.values())
    # An audit is one vehicle-night: its expected number of alarms stays within the budget whatever the nights
    # share, because expectations add; Bonferroni over the charts, because those share errors too.
    probability = config.false_alarms_per_1000_vehicle_days / 1000 / max(live, 1)
    verdicts = {}
    for key, chart in charts.items():
        scaled = Chart(chart.day, chart.value, chart.sigma * scatter.get(key, 1.0), chart.accepted)
        verdict = judge_chart(scaled, limit_of(*key, config), probability, config.baseline_days)
        verdicts[key] = _name_undetermined_days(verdict, len(pairs[key[0]].day))
    if not any(v.change for v in verdicts.values()):
        return VehicleVerdict(verdicts, None)
    scaled_pairs = {pair: _scaled(days, pair, scatter) for pair, days in pairs.items()}
    verdicts = _share_start(verdicts, scaled_pairs)
    return VehicleVerdict(verdicts, _attribute(verdicts, scaled_pairs))


def _name_undetermined_days(verdict: ChartVerdict, days: int) -> ChartVerdict:
    if verdict.status != "UNKNOWN" or verdict.days_used >= days:
        return verdict
    reason = f"determined on {verdict.days_used} of {days} days: {verdict.reason}"
    return replace(verdict, reason=reason)


def _scaled(days: PairDays, pair: str, scatter: Mapping[tuple[str, str], float]) -> PairDays:
    s = np.array([scatter.get((pair, dof), 1.0) for dof in DOF_NAMES])
    return replace(days, covariance=days.covariance * np.outer(s, s))


def _share_start(
    verdicts: dict[tuple[str, str], ChartVerdict], pairs: Mapping[str, PairDays]
) -> dict[tuple[str, str], ChartVerdict]:
    """Give all steps that may be one event the start day that all DoFs together find."""
    joint = _joint_start(pairs)
    if joint is None:
        return verdicts
    first, earliest, latest = joint
    shared = {}
    for key, verdict in verdicts.items():
        change = verdict.change
        if change and change.kind == "step" and change.earliest <= latest and earliest <= change.latest:
            change = replace(change, day=first, earliest=earliest, latest=latest)
        shared[key] = replace(verdict, change=change)
    return shared


def _joint_start(pairs: Mapping[str, PairDays]) -> tuple[int, int, int] | None:
    """Start day and interval from the full 6x6 covariances of all pairs on the days that all of them have."""
    days = _common_days(pairs)
    if len(days) < 2:
        return None
    gain = np.zeros(len(days) - 1)
    for split in range(len(gain)):
        shifts = _shifts(pairs, days, days > days[split])
        for pair in independent_pairs(shifts):
            xi, covariance = shifts[pair].xi, shifts[pair].covariance
            gain[split] += xi @ np.linalg.solve(covariance, xi)
    return start_interval(gain, days)


def _attribute(
    verdicts: Mapping[tuple[str, str], ChartVerdict], pairs: Mapping[str, PairDays]
) -> Attribution:
    change = _strongest(list(verdicts.values()))
    days = _common_days(pairs)
    # A slow drift is compared between its later half and the days before it set in, and the half between is
    # left out.
    if change.kind == "slow drift":
        middle = (change.day + days[-1]) / 2 if len(days) else change.day
        days = days[(days < change.day) | (days >= middle)]
    is_after = days >= change.day
    if not is_after.any() or is_after.all():
        return Attribution(None, "the pairs have no common days before and after", {}, np.zeros(6), np.eye(6))
    return attribute(_shifts(pairs, days, is_after))


def _strongest(verdicts: Sequence[ChartVerdict]) -> Change:
    alarms = [v for v in verdicts if v.change and v.statistic and v.threshold]
    return max(alarms, key=lambda v: (v.statistic or 0) / (v.threshold or 1)).change  # type: ignore[return-value]


def _common_days(pairs: Mapping[str, PairDays]) -> Float[np.ndarray, " N"] | np.ndarray:
    days = [set(p.day.tolist()) for p in pairs.values() if len(p.day)]
    return np.array(sorted(set.intersection(*days)) if days else [], dtype=np.int64)


def _shifts(pairs: Mapping[str, PairDays], days: np.ndarray, is_after: np.ndarray) -> dict[str, PairShift]:
    shifts = {}
    for pair in PAIRS:
        if pair in pairs and len(pairs[pair].day):
            p = pairs[pair]
            rows = np.searchsorted(p.day, days)
            shifts[pair] = pair_shift(p.T[rows], p.covariance[rows], is_after)
    return shifts
