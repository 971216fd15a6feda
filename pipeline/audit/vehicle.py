"""All charts of each vehicle, judged together: one false-alarm budget, one start day, one moved sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from pipeline.audit.changes import Change, start_interval
from pipeline.audit.days import DOFS, PairDays, charts_of_fleet, clipped_days
from pipeline.audit.noise import Noise, estimate_noise
from pipeline.audit.verdicts import ChartVerdict, judge_charts
from pipeline.config import AuditConfig
from pipeline.extrinsics.attribution import Attribution, PairShift, attribute, pair_shift
from schemas.calibrations import DOF_NAMES, PAIRS

__all__ = ["VehicleVerdict", "independent_pairs", "judge_fleet", "limit_of"]

# The thresholds' bound is loose: it takes splits and charts as unrelated and days at face value, where single days are
# clipped and RED needs a size that matters. Set for 50 per 1,000 vehicle-nights, RED came 1.2, 0.1 and 0.1 times
# (Student's t with 4 degrees of freedom, AR(1) 0.6, wrong sigmas; 20,700 nights each, seed 101 of study drift_charts).
# So they are set for this many times the budget, and the study proves it on other seeds.
_BOUND_IS_LOOSE = 15.0
# Camera_radar is composed of the other two where it is nearer to them than this [rad, m].
_COMPOSED_WITHIN = 1e-6


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


def judge_fleet(fleet: Sequence[Mapping[str, PairDays]], config: AuditConfig) -> list[VehicleVerdict]:
    """Judge all charts of all vehicles.

    Args:
        fleet: by vehicle, day estimates by pair; a pair may be missing.
        config: limits and the false-alarm budget.
    """
    if not fleet:
        return []
    charts = charts_of_fleet(fleet)
    noise = estimate_noise(charts, DOFS, len(PAIRS))
    per_vehicle = len(PAIRS) * DOFS
    live = (charts.count > 1).reshape(len(fleet), per_vehicle).sum(axis=1)
    # An audit is one vehicle-night: its expected number of alarms stays within the budget whatever the nights
    # share, because expectations add; Bonferroni over the charts, because those share errors too.
    budget = np.minimum(_BOUND_IS_LOOSE * config.false_alarms_per_1000_vehicle_days / 1000, 0.5)
    probability = budget / np.maximum(live, 1)
    limit = np.array([limit_of(pair, dof, config) for pair in PAIRS for dof in DOF_NAMES])
    verdicts = judge_charts(
        charts,
        noise,
        np.tile(limit, len(fleet)),
        np.repeat(probability, per_vehicle),
        config.baseline_days,
    )
    return [
        _judged(pairs, verdicts[v * per_vehicle : (v + 1) * per_vehicle], _part(noise, v, per_vehicle))
        for v, pairs in enumerate(fleet)
    ]


def _part(noise: Noise, v: int, size: int) -> Noise:
    at = slice(v * size, (v + 1) * size)
    return Noise(noise.scale[at], noise.freedom[at], noise.autocorrelation[at])


def _judged(pairs: Mapping[str, PairDays], verdicts: Sequence[ChartVerdict], noise: Noise) -> VehicleVerdict:
    """One vehicle: what its charts say, with the start that they share, and the sensor that moved."""
    keys = [(pair, dof) for pair in PAIRS for dof in DOF_NAMES]
    charts = {
        key: _name_undetermined_days(verdict, len(pairs[key[0]].day))
        for key, verdict in zip(keys, verdicts, strict=True)
        if key[0] in pairs
    }
    if not any(v.change for v in charts.values()):
        return VehicleVerdict(charts, None)
    strongest = _strongest(list(charts.values()))
    days = _common_days(pairs)
    if strongest.kind == "step":
        days = days[(days < strongest.day) | (days >= strongest.settled)]
    seen = {pair: found for pair, found in pairs.items() if len(found.day)}
    if len(days) and strongest.day < days[-1]:  # a last day that stands alone is what it is
        scale = noise.scale.reshape(len(PAIRS), DOFS)
        seen = {pair: clipped_days(found, scale[PAIRS.index(pair)]) for pair, found in seen.items()}
    seen = independent_pairs(seen, days)
    charts = _share_start(charts, _joint_start(seen, days))
    return VehicleVerdict(charts, _attribute(_strongest(list(charts.values())), seen, noise, days))


def _name_undetermined_days(verdict: ChartVerdict, days: int) -> ChartVerdict:
    if verdict.status != "UNKNOWN" or verdict.days_used >= days:
        return verdict
    reason = f"determined on {verdict.days_used} of {days} days: {verdict.reason}"
    return replace(verdict, reason=reason)


def independent_pairs(pairs: Mapping[str, PairDays], days: Int[np.ndarray, " N"]) -> dict[str, PairDays]:
    """Pairs whose errors are their own: camera_radar is left out where it is composed of the other two."""
    if len(pairs) < len(PAIRS) or not len(days):
        return dict(pairs)
    T = {pair: p.T[np.searchsorted(p.day, days[-1])] for pair, p in pairs.items()}
    gap = np.abs(T["camera_lidar"] @ T["lidar_radar"] - T["camera_radar"]).max()
    return {p: d for p, d in pairs.items() if p != "camera_radar" or gap > _COMPOSED_WITHIN}


def _share_start(
    verdicts: dict[tuple[str, str], ChartVerdict], joint: tuple[int, int, int] | None
) -> dict[tuple[str, str], ChartVerdict]:
    """Give all steps that may be one event the start day that all DoFs together find."""
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


def _joint_start(pairs: Mapping[str, PairDays], days: Int[np.ndarray, " N"]) -> tuple[int, int, int] | None:
    """Start day and interval from the full 6x6 covariances of all pairs on the days that all of them have."""
    if len(days) < 2:
        return None
    gain = np.zeros(len(days) - 1)
    for found in pairs.values():
        rows = np.searchsorted(found.day, days)
        information = np.linalg.inv(found.spread[rows])
        moment = np.einsum("nij,nj->ni", information, found.change[rows])
        before, after = (np.cumsum(a, axis=0)[:-1] for a in (information, information[::-1]))
        after = after[::-1]
        left, right = (np.cumsum(a, axis=0)[:-1] for a in (moment, moment[::-1]))
        size = np.linalg.solve(after, right[::-1, :, None]) - np.linalg.solve(before, left[:, :, None])
        covariance = np.linalg.inv(before) + np.linalg.inv(after)
        gain += (size * np.linalg.solve(covariance, size)).sum(axis=(1, 2))
    return start_interval(gain, days)


def _attribute(
    change: Change, pairs: Mapping[str, PairDays], noise: Noise, days: Int[np.ndarray, " N"]
) -> Attribution:
    # A slow drift is compared between its later half and the days before it set in, and the half between is
    # left out.
    if change.kind == "slow drift":
        middle = (change.day + days[-1]) / 2 if len(days) else change.day
        days = days[(days < change.day) | (days >= middle)]
    is_after = days >= change.day
    if not is_after.any() or is_after.all():
        return Attribution(None, "the pairs have no common days before and after", {}, np.zeros(6), np.eye(6))
    freedom = noise.freedom.reshape(len(PAIRS), DOFS)
    known_by = min(float(freedom[PAIRS.index(pair)].min()) for pair in pairs)
    return attribute(_shifts(pairs, noise, days, is_after), known_by)


def _strongest(verdicts: Sequence[ChartVerdict]) -> Change:
    alarms = [v for v in verdicts if v.change and v.statistic and v.threshold]
    best = max(alarms, key=lambda v: (v.status == "RED", (v.statistic or 0) / (v.threshold or 1)))
    assert best.change is not None, "only alarms were asked for"
    return best.change


def _common_days(pairs: Mapping[str, PairDays]) -> Int[np.ndarray, " N"]:
    days = [set(p.day.tolist()) for p in pairs.values() if len(p.day)]
    return np.array(sorted(set.intersection(*days)) if days else [], dtype=np.int64)


def _shifts(
    pairs: Mapping[str, PairDays], noise: Noise, days: Int[np.ndarray, " N"], is_after: np.ndarray
) -> dict[str, PairShift]:
    shifts = {}
    for p, pair in enumerate(PAIRS):
        if pair in pairs:
            found = pairs[pair]
            rows = np.searchsorted(found.day, days)
            phi = float(noise.autocorrelation[p * DOFS])
            shifts[pair] = pair_shift(found.origin, found.change[rows], found.spread[rows], is_after, phi)
    return shifts
