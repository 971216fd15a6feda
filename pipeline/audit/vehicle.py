"""All charts of each vehicle, judged together: one false-alarm budget, one start day, one moved sensor.

The size of an edge's change, in all six degrees of freedom at once, is by generalised least squares with full
covariances; `scan.py` does the same for one degree of freedom. If a day has a larger sigma than most, the additional
variance is independent of the other days. A fixed reference is the mean of earlier days.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from pipeline.audit.changes import Change, start_interval
from pipeline.audit.days import DOFS, PairDays, charts_of_fleet, clipped_days, edges_of_fleet
from pipeline.audit.noise import Noise, estimate_noise
from pipeline.audit.reasons import REASONS, because
from pipeline.audit.scan import SAME, alike
from pipeline.audit.verdicts import ChartVerdict, judge_charts
from pipeline.audit.wander import with_wander
from pipeline.core.config import AuditConfig
from pipeline.rig.attribution import Attribution, PairShift, attribute
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import change_jacobian
from schemas.calibrations import DOF_NAMES

__all__ = ["VehicleVerdict", "Whitened", "independent_edges", "judge_fleet", "limit_of"]

# Share of vehicle-nights with a YELLOW that nothing caused, for a change that may have begun: a person looks again the
# next day, nobody opens a car.
_YELLOW = 0.02
# A camera-radar edge is composed of two others where it is nearer to them than this [rad, m].
_COMPOSED_WITHIN = 1e-6


@dataclass(frozen=True, eq=False)
class VehicleVerdict:
    """Verdicts by (edge, dof), and the sensor that moved; `attribution` is None without an alarm."""

    charts: dict[tuple[Edge, str], ChartVerdict]
    attribution: Attribution | None


def limit_of(edge: Edge, dof: str, config: AuditConfig) -> float:
    """Size of a change that matters [rad or m]."""
    if dof.startswith("t"):
        return config.translation_limit_m
    has_radar = "radar" in (sensor.kind for sensor in edge.sensors)
    return float(np.radians(config.radar_limit_deg if has_radar else config.camera_lidar_limit_deg))


def judge_fleet(
    fleet: Sequence[Mapping[Edge, PairDays]], config: AuditConfig, models: Sequence[str] = ()
) -> list[VehicleVerdict]:
    """Judge all charts of all vehicles; `models` has the rig of each vehicle (empty = all have the same one)."""
    edges = edges_of_fleet(fleet)
    if not edges:
        return [VehicleVerdict({}, None) for _ in fleet]
    charts = charts_of_fleet(fleet, edges)
    limit = np.array([limit_of(edge, dof, config) for edge in edges for dof in DOF_NAMES])
    limit = np.tile(limit, len(fleet))
    shape = len(fleet), len(edges), DOFS
    noise = with_wander(charts, estimate_noise(charts, shape, models), limit, shape, models)
    per_vehicle = len(edges) * DOFS
    live = (charts.count > 1).reshape(len(fleet), per_vehicle).sum(axis=1)
    # An audit is one vehicle-night: its expected number of alarms stays within the budget whatever the nights
    # share, because expectations add; Bonferroni over the charts, because those share errors too.
    alarm = min(config.false_alarms_per_1000_vehicle_days / 1000, 0.5)
    budget = np.array([alarm, max(alarm, _YELLOW)])
    probability = budget[:, None] / np.maximum(live, 1)
    verdicts = judge_charts(
        charts, noise, limit, np.repeat(probability, per_vehicle, axis=1), config.baseline_days
    )
    found = []
    for own, first in zip(fleet, range(0, len(verdicts), per_vehicle), strict=True):
        by_edge = {
            edge: noise.at(slice(first + k * DOFS, first + (k + 1) * DOFS)) for k, edge in enumerate(edges)
        }
        found.append(_judged(own, verdicts[first : first + per_vehicle], by_edge))
    return found


def _judged(
    own: Mapping[Edge, PairDays], verdicts: Sequence[ChartVerdict], noise: Mapping[Edge, Noise]
) -> VehicleVerdict:
    """One vehicle: verdicts of its charts with their common start, and the sensor that moved."""
    keys = [(edge, dof) for edge in noise for dof in DOF_NAMES]
    charts = {
        key: _name_undetermined_days(verdict, len(own[key[0]].day))
        for key, verdict in zip(keys, verdicts, strict=True)
        if key[0] in own
    }
    if not any(v.change for v in charts.values()):
        return VehicleVerdict(charts, None)
    strongest = _strongest(list(charts.values()))
    seen = {edge: found for edge, found in own.items() if len(found.day)}
    seen, days = _with_common_days(seen, strongest.day)
    if strongest.kind == "step":
        days = days[(days < strongest.day) | (days >= strongest.settled)]
    alone = len(days) > 0 and strongest.day == int(days[-1])  # a last day that stands alone is what it is
    whitened = [_whitened(seen, some, days, alone=alone) for some in _as_alike_as_may_be(noise)]
    if len(days) > 1:  # by the full 6x6 covariances of all edges, on the days that all of them have
        gains = np.sum([found.step_gains() for found in whitened[0].values()], axis=0)
        charts = _share_start(charts, start_interval(gains, days))
    return VehicleVerdict(charts, _attribute(_strongest(list(charts.values())), whitened, noise, days))


def _as_alike_as_may_be(noise: Mapping[Edge, Noise]) -> list[Mapping[Edge, Noise]]:
    """The noise with the highest plausible autocorrelation, and that with the lowest if it differs."""
    less = {edge: found.less_alike or found for edge, found in noise.items()}
    if all(np.allclose(noise[e].autocorrelation, less[e].autocorrelation, atol=SAME) for e in noise):
        return [noise]
    return [noise, less]


def _whitened(
    seen: Mapping[Edge, PairDays], noise: Mapping[Edge, Noise], days: Int[np.ndarray, " N"], *, alone: bool
) -> dict[Edge, Whitened]:
    if len(days) < 2:
        return {}
    if not alone:
        seen = {edge: clipped_days(found, noise[edge].scale) for edge, found in seen.items()}
    return {
        edge: Whitened.of(
            found.at(np.searchsorted(found.day, days)), noise[edge].autocorrelation, noise[edge].wander
        )
        for edge, found in independent_edges(seen, days).items()
    }


def _name_undetermined_days(verdict: ChartVerdict, days: int) -> ChartVerdict:
    if verdict.status != "UNKNOWN" or verdict.days_used >= days:
        return verdict
    reason = because("determined on", used=verdict.days_used, days=days, reason=verdict.reason)
    return replace(verdict, reason=reason)


def independent_edges(own: Mapping[Edge, PairDays], days: Int[np.ndarray, " N"]) -> dict[Edge, PairDays]:
    """Edges with independent errors: without camera-radar edges that are composed of two others."""
    if not len(days):
        return dict(own)
    T = {edge: found.T[np.searchsorted(found.day, days[-1])] for edge, found in own.items()}
    composed = {
        edge
        for edge in own
        for first in own
        for second in own
        if edge.kind == "camera_radar"
        and (first.parent, first.child, second.child) == (edge.parent, second.parent, edge.child)
        and np.abs(T[first] @ T[second] - T[edge]).max() <= _COMPOSED_WITHIN
    }
    return {edge: found for edge, found in own.items() if edge not in composed}


def _share_start(
    verdicts: dict[tuple[Edge, str], ChartVerdict], joint: tuple[int, int, int]
) -> dict[tuple[Edge, str], ChartVerdict]:
    """Give all steps that may be one event the start day that all DoFs together find."""
    first, earliest, latest = joint
    shared = {}
    for key, verdict in verdicts.items():
        change = verdict.change
        if change and change.kind == "step" and change.earliest <= latest and earliest <= change.latest:
            change = replace(change, day=first, earliest=earliest, latest=latest)
        shared[key] = replace(verdict, change=change)
    return shared


def _attribute(
    change: Change,
    whitened: Sequence[Mapping[Edge, Whitened]],
    noise: Mapping[Edge, Noise],
    days: Int[np.ndarray, " N"],
) -> Attribution:
    """Attribution from the shifts of all edges, by the estimator that is best for any autocorrelation."""
    shape = (days >= change.day).astype(float)
    if not shape.any() or shape.all():
        return Attribution(REASONS["no common days"])
    if change.kind == "slow drift":  # from the last day before it on
        shape = np.maximum(days - days[shape == 0][-1], 0.0)
        shape /= shape[-1]
    shifts = [
        {
            edge: found.shift(shape, [other[edge] for other in whitened if other is not own])
            for edge, found in own.items()
        }
        for own in whitened
    ]
    surest = min(shifts, key=lambda own: sum(np.linalg.slogdet(s.covariance)[1] for s in own.values()))
    return attribute(surest, min(float(noise[edge].freedom.min()) for edge in surest))


def _strongest(verdicts: Sequence[ChartVerdict]) -> Change:
    alarms = [v for v in verdicts if v.change and v.statistic and v.threshold]
    best = max(alarms, key=lambda v: (v.status == "RED", (v.statistic or 0) / (v.threshold or 1)))
    assert best.change is not None, "only alarms were asked for"
    return best.change


def _with_common_days(
    own: Mapping[Edge, PairDays], start: int
) -> tuple[dict[Edge, PairDays], Int[np.ndarray, " N"]]:
    """Edges, and their common days, without edges that have no days on both sides of a start.

    An edge that ended before the change, or began after it, has no information on it, and must not hide the
    others.
    """
    left = dict(own)
    days = _common_days(left)
    while len(left) > 1 and not (len(days) and days[0] < start <= days[-1]):
        fewest = min(left, key=lambda edge: min(_sides(left[edge].day, start)))
        if min(_sides(left[fewest].day, start)):
            return dict(own), _common_days(own)
        del left[fewest]
        days = _common_days(left)
    return left, days


def _sides(day: Int[np.ndarray, " N"], start: int) -> tuple[int, int]:
    """Numbers of days before and from a start on."""
    before = int(np.searchsorted(day, start))
    return before, len(day) - before


def _common_days(own: Mapping[Edge, PairDays]) -> Int[np.ndarray, " N"]:
    days = [set(found.day.tolist()) for found in own.values() if len(found.day)]
    return np.array(sorted(set.intersection(*days)) if days else [], dtype=np.int64)


_LEAST = 1e-6  # of what varies: the floor of a combination of DoF that a covariance takes for known


@dataclass(frozen=True, eq=False)
class Whitened:
    """Days of one edge, transformed so that all errors are independent with variance 1.

    `change` is whitened (6 N), from `origin`; `root` is the lower triangle of the covariance (6 N, 6 N).
    """

    days: Int[np.ndarray, " N"]
    origin: Float[np.ndarray, "4 4"]
    change: Float[np.ndarray, " X"]
    root: Float[np.ndarray, "X X"]

    @classmethod
    def of(
        cls, days: PairDays, autocorrelation: Float[np.ndarray, " 6"], wander: Float[np.ndarray, " 6"]
    ) -> Whitened:
        """Days whitened for this autocorrelation per axis and for a level that gains variance `wander` a day."""
        N, sigma = len(days.day), days.sigma
        correlation = days.spread / (sigma[:, :, None] * sigma[:, None, :])
        values, vectors = np.linalg.eigh(correlation)
        root = (vectors * np.sqrt(np.maximum(values, _LEAST))[:, None, :]) @ vectors.swapaxes(1, 2)
        root = sigma[:, :, None] * root
        share = np.minimum(1.0, np.median(np.median(sigma, axis=0) / sigma, axis=1))
        own = (1 - share**2)[:, None, None] * (root @ root.swapaxes(1, 2))
        if days.reference_days:
            many = np.array([days.reference_days])
            share[0], own[0] = 0.0, root[0] @ root[0].T * alike(many, autocorrelation.mean(keepdims=True))[0]
        root = share[:, None, None] * root
        gap = np.abs(days.day[:, None] - days.day)[:, :, None]
        covariance = np.einsum("iac,ijc,jbc->iajb", root, autocorrelation**gap, root)
        covariance[np.arange(N), :, np.arange(N)] += own
        since = days.day - days.day[0]
        covariance[:, range(DOFS), :, range(DOFS)] += wander[:, None, None] * np.minimum.outer(since, since)
        L = np.linalg.cholesky(covariance.reshape(DOFS * N, DOFS * N))
        return cls(days.day, days.origin, solve_triangular(L, days.change.ravel(), lower=True), L)

    def shift(self, shape: Float[np.ndarray, " N"], others: Sequence[Whitened] = ()) -> PairShift:
        """The change, from its share on each day: 0 before it, 1 once it is complete.

        `others` are alternative error models of the days; the largest of all their sigmas is returned.
        """
        X = self._designed(np.stack([np.ones(len(shape)), shape], axis=1))
        gain = np.linalg.solve(X.T @ X, X.T)[DOFS:]
        of_days = solve_triangular(self.root, gain.T, lower=True, trans="T").T
        unsure = [part @ part.T for part in (gain, *(of_days @ other.root for other in others))]
        covariance = max(unsure, key=lambda c: float(np.linalg.slogdet(c)[1]))
        to_twist = np.linalg.inv(change_jacobian(self.origin))
        return PairShift(self.origin, to_twist @ gain @ self.change, to_twist @ covariance @ to_twist.T)

    def step_gains(self) -> Float[np.ndarray, " S"]:
        """Twice the log-likelihood gain of a step at each split."""
        N = len(self.days)
        level, _ = np.linalg.qr(self._designed(np.ones((N, 1))))
        steps = self._designed(np.tri(N)[:, 1:])
        steps -= level @ (level.T @ steps)
        steps = steps.reshape(DOFS * N, N - 1, DOFS)
        left = self.change - level @ (level.T @ self.change)
        information = np.einsum("nsi,nsj->sij", steps, steps)
        moment = np.einsum("nsi,n->si", steps, left)
        return np.asarray(
            np.einsum("si,si->s", moment, np.linalg.solve(information, moment[..., None])[..., 0])
        )

    def _designed(self, columns: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "X Y"]:
        """Whitened design matrix of the changes given by each column's share, six degrees of freedom each."""
        return np.asarray(solve_triangular(self.root, np.kron(columns, np.eye(DOFS)), lower=True))
