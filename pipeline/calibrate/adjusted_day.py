"""Edges of a day that were solved, the rig adjusted over their evidence, and each edge judged again at the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.rig import AdjustedRig, adjust
from pipeline.calibrate.judging import Judged, Judging
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.calibrate.reasons import because
from pipeline.calibrate.select.frames import Selection
from pipeline.rig.estimates import Check, EdgeEvidence, PairEstimate, Prior, Solution, change_of
from pipeline.rig.graph import Edge, RigGraph, pose_columns
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import adjoint, change_between, compose_covariance, inverse
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["Concluded", "SolvedDay", "SolvedEdge", "adjusted_rig", "conclude"]

# --------------------------------------------------------------------------------------------------
# A day with solved and judged pairs, and an edge of any kind between its own solution and its record.


@dataclass(frozen=True, eq=False)
class SolvedDay:
    """A day's inputs, results and verdicts.

    Args:
        solution: solution of the pairs that were not refused.
        judging: data that verdicts depend on.
        trigger_sample: frames for the trigger metrics; empty for methods other than the paper's, unless
            `trigger.when` needs them.
        trigger_before: metrics of each pair at the prior.
        triggered: by pair, whether one of the metrics exceeds its threshold.
        numbers: numbers of checks of the day, for every record.
    """

    observations: Sequence[Observation]
    selection: Selection
    prior: Prior
    solution: Solution
    judged: Mapping[str, Judged]
    failed: Mapping[str, Sequence[Check]]
    judging: Judging
    trigger_sample: Sequence[Observation]
    trigger_before: Mapping[str, Mapping[str, float]]
    triggered: Mapping[str, bool]
    numbers: Mapping[str, float] = field(default_factory=dict)


# Verdict on an estimate of an edge with its failed checks, and whether other edges take part in it.
Judge = Callable[[PairEstimate, Sequence[Check], bool], Judged]


@dataclass(frozen=True, eq=False)
class SolvedEdge:
    """An edge that was solved and judged by its own data: one form for every kind.

    Args:
        own: estimate by its own data and its prior.
        judged: the verdict on it.
        evidence: without the prior, and the reason why the rig must not use it, if there is one.
        failed: failed checks, for every verdict on it.
        judge: how it is judged at another estimate.
        record: its record, from an estimate with its verdict.
        is_active: False for a pair that no trigger asked for, which keeps the prior.
    """

    edge: Edge
    own: PairEstimate
    judged: Judged
    evidence: EdgeEvidence
    failed: Sequence[Check]
    judge: Judge
    record: Callable[[PairEstimate, Judged], CalibrationRecord]
    is_active: bool = True

    def with_checks(self, checks: Sequence[Check]) -> SolvedEdge:
        """The edge, judged with failed checks of the whole rig besides."""
        failed = (*self.failed, *checks)
        judged = self.judge(self.own, failed, False)
        evidence = replace(self.evidence, checks=judged.verdict.against)
        return replace(self, failed=failed, judged=judged, evidence=evidence)


# --------------------------------------------------------------------------------------------------
# Adjustment of a rig over the evidence of its edges; each edge is judged again at the result.
#
# An edge that failed a check is left out and keeps its pose and verdict. An edge with too little data to be
# judged alone, as camera-radar mostly is, is certified at the adjusted pose. Its own evidence stands beside it in the
# record.


_SIGMAS = 3.0  # by which an edge that is left out contradicts the rest


def adjusted_rig(
    graph: RigGraph, prior: Extrinsics, edges: Sequence[SolvedEdge], clock_sigma_s: float
) -> AdjustedRig | None:
    """The rig adjusted over the evidence of its edges; None if there is none.

    `prior` is of all sensors that have one.
    """
    known = [e for e in edges if {s.name for s in e.edge.sensors} <= set(prior.T)]
    if not known:
        return None
    sensors = tuple(s for s in graph.sensors if s.name in prior.T)
    there = tuple(e for e in graph.edges if set(e.sensors) <= set(sensors))
    graph = RigGraph(sensors, there, graph.reference)
    expected = {e.edge: e.own.time_offset_prior_s for e in edges}
    clocks = {edge: dt_s for edge, dt_s in expected.items() if dt_s is not None}
    prior = replace(prior, dt_s=_expected_clocks(graph, clocks))
    return adjust(graph, prior, [e.evidence for e in known], clock_sigma_s)


@dataclass(frozen=True, eq=False)
class Concluded:
    """An edge's record; `is_adjusted` if it states the adjusted pose, and not what the edge found alone."""

    edge: Edge
    record: CalibrationRecord
    is_adjusted: bool


def conclude(
    edges: Sequence[SolvedEdge],
    rig: AdjustedRig | None,
    against: Callable[[Edge], list[Check]] = lambda _: [],
) -> list[Concluded]:
    """The record of each edge: at the adjusted pose, unless it is held by checks of its own or left out.

    A left-out edge whose pose the others certify states that pose. `against` has checks of the whole rig besides.
    """
    estimates = {e.edge: e.own for e in edges}
    return [_concluded(e, rig, estimates, against(e.edge)) for e in edges]


def _concluded(
    edge: SolvedEdge, rig: AdjustedRig | None, estimates: Mapping[Edge, PairEstimate], more: Sequence[Check]
) -> Concluded:
    at = None if rig is None else rig.edges.get(edge.edge)
    if rig is None or at is None:
        return Concluded(edge.edge, edge.record(edge.own, edge.judged), is_adjusted=False)
    estimate, judged = edge.own, edge.judged
    if edge.is_active and not edge.judged.held_by:
        adjusted = _of_rig(edge, rig, estimates)
        against = [*_contradictions(edge, rig, adjusted, estimates), *more]
        again = edge.judge(adjusted, [*edge.failed, *against], True)
        if at.used or again.verdict.status == "accepted":
            estimate, judged = adjusted.doubted(again.doubt), again
        elif against and not edge.evidence.checks:  # else it is held by what it failed itself
            judged = edge.judge(edge.own, [*edge.failed, *against], False)
    record = edge.record(estimate, judged)
    is_adjusted = estimate is not edge.own
    if is_adjusted and record.status != "refused":
        record = replace(record, **_own_columns(edge.own))
    record = replace(record, innovation_sigmas=at.innovation_sigmas, used=at.used)
    return Concluded(edge.edge, record, is_adjusted)


def _own_columns(own: PairEstimate) -> dict[str, Any]:
    """What an edge found alone, beside the adjusted pose of its record."""
    return pose_columns(own.T, "own_") | {
        "own_covariance": own.covariance,
        "own_common_covariance": own.common_covariance,
        "own_observable": [bool(v) for v in own.observable],
    }


def _contradictions(
    solved: SolvedEdge, rig: AdjustedRig, adjusted: PairEstimate, estimates: Mapping[Edge, PairEstimate]
) -> list[Check]:
    """Contradictions of other edges to this one, of edges left out too unless they are known to be wrong.

    An edge that others in use confirm on another way is not contradicted by what is left out, and none is by an edge
    that lies far from its prior, which holds what rests on that prior (`wrong_priors`). Camera-lidar is not
    checked, for its held-out frames would show any error that a radar's edges can show, unless its camera's motion
    takes part: held-out borders err with the others, and so may boxes, which are of the same networks.
    """
    edge = solved.edge
    own, found = rig.edges[edge], dict[str, list[Edge]]()
    by_motion = [e for e in rig.edges if e.kind == "camera_base" and e.parent == edge.parent]
    is_out = not (own.used or own.doubts or solved.evidence.checks)
    if edge.kind == "camera_lidar" and any(is_out and rig.edges[e].used for e in by_motion):
        found[because("other edges", edge=edge.name)] = [edge]
    outvoted = [
        e for e in by_motion if not (rig.edges[e].used or rig.edges[e].doubts or rig.edges[e].evidence.checks)
    ]
    if edge.kind in ("camera_lidar", "camera_radar") and own.used and outvoted:
        found[because("other edges", edge=outvoted[0].name)] = outvoted
    is_accepted = edge.kind == "camera_lidar" and solved.judged.verdict.status == "accepted"
    if is_accepted and not found and not set(by_motion) & set(own.doubts):
        return []
    of_ends = (d for s in edge.sensors if s.name in rig.sensors for d in rig.sensors[s.name].doubts)
    doubts = tuple(dict.fromkeys([*own.doubts, *of_ends]))  # its own, and of edges that its pose rests on
    if doubts:
        found[", ".join(e.name for e in doubts)] = [e for e in doubts if not rig.edges[e].used]
    is_confirmed = own.used and own.innovation_sigmas is not None
    for other, at in () if is_confirmed else rig.edges.items():
        is_explained = any(c.disproves or c.fault == "prior" for c in at.evidence.checks)
        if other == edge or at.used or other in doubts or is_explained:
            continue
        if (at.innovation_sigmas or 0.0) > _SIGMAS:
            found[because("other edges", edge=other.name)] = [other]
    checks = []
    for who, out in found.items():
        sentence = because("edges", edges=who)
        around = _around(edge, out[0], rig, estimates) if len(out) == 1 else None
        if around is None:  # nobody knows by how much
            checks.append(Check(sentence, "witnesses_disagree"))
            continue
        error = change_of(change_between(adjusted.T, around[0]))
        checks.append(Check(sentence, "witnesses_disagree", error=error, covariance=around[1]))
    return checks


def _around(
    edge: Edge, out: Edge, rig: AdjustedRig, estimates: Mapping[Edge, PairEstimate]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]] | None:
    """Pose of an edge by the way over one that the rig does without, and its covariance (left perturbation).

    So it is if the edge that is left out is right. None if it has no estimate, or no edges in use lead there.
    """
    if out not in estimates:
        return None
    used = tuple(e for e, at in rig.edges.items() if at.used and e not in (edge, out))
    graph = RigGraph(tuple({s for e in rig.edges for s in e.sensors}), used, edge.parent)
    poses, found = rig.poses, estimates[out]
    T, covariance = found.T, found.covariance
    for first, last in (out.sensors, out.sensors[::-1]):
        if graph.path(edge.parent, first) is not None and graph.path(last, edge.child) is not None:
            before, after = (edge.parent.name, first.name), (last.name, edge.child.name)
            T_before, of_before = poses.between(*before), poses.covariance_between(*before)
            covariance = compose_covariance(T, covariance, poses.covariance_between(*after))
            return T_before @ T @ poses.between(*after), compose_covariance(T_before, of_before, covariance)
        A = adjoint(inverse(T))
        T, covariance = inverse(T), A @ covariance @ A.T
    return None


def _of_rig(solved: SolvedEdge, rig: AdjustedRig, estimates: Mapping[Edge, PairEstimate]) -> PairEstimate:
    """An edge's estimate at the adjusted pose, with the other results of its own frames."""
    own, edge = solved.own, solved.edge
    parent, child = (s.name for s in edge.sensors)
    observability = rig.observability(parent, child)
    sensors = tuple({s for e in rig.edges for s in e.sensors})
    way = RigGraph(sensors, tuple(rig.edges), edge.parent).without([edge]).path(*edge.sensors)
    others = [estimates[e].frames_used for e in way or () if e in estimates]
    dt = {n: rig.poses.dt_s.get(n, 0.0) for n in (parent, child)}
    sigmas = [rig.sensors[n].dt_sigma_s for n in (parent, child) if n in rig.sensors]
    return replace(
        own, T=rig.poses.between(parent, child), covariance=rig.poses.covariance_between(parent, child),
        common_covariance=rig.poses.covariance_between(parent, child, common=True),
        observability=observability, observable=observability >= OBSERVABLE,
        frames_used=max(own.frames_used, min(others, default=0)), time_offset_s=dt[child] - dt[parent],
        time_offset_sigma_s=float(np.hypot.reduce(sigmas)),
    )  # fmt: skip


def _expected_clocks(graph: RigGraph, clocks: Mapping[Edge, float]) -> dict[str, float]:
    """Expected offset of each clock to the reference's, along edges that estimate one."""
    timed = graph.with_edges(clocks)
    found = {graph.reference.name: 0.0}
    for sensor in graph.sensors:
        at, offset_s = graph.reference, 0.0
        for edge in timed.path(graph.reference, sensor) or ():
            forward = edge.parent == at
            offset_s += clocks[edge] if forward else -clocks[edge]
            at = edge.other(at.name)
        found[sensor.name] = offset_s
    return found
