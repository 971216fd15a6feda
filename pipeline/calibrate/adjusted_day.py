"""Joint adjustment of a day's pairs over their evidence; each pair is judged again at the result.

An edge that failed a check is left out and keeps its pose and verdict. An edge with too little data to be
judged alone, as camera-radar mostly is, is certified at the adjusted pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustmentLimits
from pipeline.calibrate.adjust.evidence import evidence_of
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.numerics.covariance import OBSERVABLE
from pipeline.calibrate.solved import SolvedDay
from pipeline.core.config import FleetConfig
from pipeline.rig.changes import change_between
from pipeline.rig.checks import FailedCheck, change_of
from pipeline.rig.estimates import PairEstimate, Solution
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, RigGraph
from pipeline.rig.se3 import adjoint, compose_covariance, inverse

__all__ = ["adjusted_rig", "clocks_of", "evidence_of_day", "judged_together"]

_SIGMAS = 3.0  # by which an edge that is left out contradicts the rest


def evidence_of_day(day: SolvedDay, edges: Mapping[str, Edge], fleet: FleetConfig) -> list[EdgeEvidence]:
    """Evidence of the pairs, and the reason for leaving out pairs held for more than a wide sigma."""
    return [
        evidence_of(
            estimate,
            edges[pair],
            day.prior,
            fleet.solve.time_offset_sigma_s,
            day.judged[pair].verdict.against,
        )
        for pair, estimate in day.solution.pairs.items()
    ]


def clocks_of(day: SolvedDay, edges: Mapping[str, Edge]) -> dict[Edge, float]:
    """Expected time offset of pairs that estimate one."""
    expected = {edges[p]: e.time_offset_prior_s for p, e in day.solution.pairs.items()}
    return {edge: dt_s for edge, dt_s in expected.items() if dt_s is not None}


def adjusted_rig(
    graph: RigGraph,
    prior: Extrinsics,
    evidence: Sequence[EdgeEvidence],
    clocks: Mapping[Edge, float],
    clock_sigma_s: float,
) -> AdjustedRig | None:
    """The rig adjusted over evidence; None if there is none.

    Args:
        prior: of all sensors that have one.
        clocks: what is expected of the time offset of edges that time a sensor.
    """
    known = [e for e in evidence if {s.name for s in e.edge.sensors} <= set(prior.T)]
    if not known:
        return None
    sensors = tuple(s for s in graph.sensors if s.name in prior.T)
    edges = tuple(e for e in graph.edges if set(e.sensors) <= set(sensors))
    graph = RigGraph(sensors, edges, graph.reference)
    prior = replace(prior, dt_s=_expected_clocks(graph, clocks))
    return adjust(graph, prior, known, AdjustmentLimits(clock_sigma_s))


def judged_together(day: SolvedDay, rig: AdjustedRig | None, edges: Mapping[str, Edge]) -> SolvedDay:
    """The day at the adjusted poses."""
    if rig is None:
        return day
    pairs, verdicts = dict(day.solution.pairs), dict(day.judged)
    for pair, own in day.solution.pairs.items():
        if day.judged[pair].held_by or pair not in day.judging.active or edges[pair] not in rig.edges:
            continue
        estimate = _of_rig(own, edges[pair], rig, day.solution)
        against = _contradictions(edges[pair], rig, day, estimate, edges)
        failed = [*day.failed[pair], *against]
        again = day.judging.pair(estimate, failed, together=True)
        if edges[pair] not in rig.left_out or again.verdict.status == "accepted":
            pairs[pair], verdicts[pair] = estimate.doubted(again.doubt), again
        elif against:
            verdicts[pair] = day.judging.pair(own, failed, together=False)
    return replace(day, solution=replace(day.solution, pairs=pairs), judged=verdicts)


def _contradictions(
    edge: Edge, rig: AdjustedRig, day: SolvedDay, adjusted: PairEstimate, edges: Mapping[str, Edge]
) -> list[FailedCheck]:
    """Contradictions of other edges to this one, of edges left out too unless they are known to be wrong.

    Camera-lidar is not checked: its held-out frames would show any error that a radar's edges can show.
    """
    if edge.kind == "camera_lidar" and day.judged[edge.kind].verdict.status == "accepted":
        return []
    found: dict[str, list[Edge]] = {}
    if doubts := rig.edges[edge].doubts:
        found[", ".join(e.name for e in doubts)] = [e for e in doubts if not rig.edges[e].used]
    for other, at in rig.edges.items():
        if other == edge or at.used or other in doubts or any(c.disproves for c in at.evidence.checks):
            continue
        if (at.innovation_sigmas or 0.0) > _SIGMAS:
            found[f"{other.name} and the other edges"] = [other]
    estimates = {edges[pair]: estimate for pair, estimate in day.solution.pairs.items()}
    checks = []
    for who, out in found.items():
        sentence = f"{who} contradict each other and nothing tells which is wrong"
        around = _around(edge, out[0], rig, estimates) if len(out) == 1 else None
        if around is None:  # nobody knows by how much
            checks.append(FailedCheck(sentence, "witnesses_disagree"))
            continue
        error = change_of(change_between(adjusted.T, around[0]))
        checks.append(FailedCheck(sentence, "witnesses_disagree", error=error, covariance=around[1]))
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


def _of_rig(own: PairEstimate, edge: Edge, rig: AdjustedRig, solution: Solution) -> PairEstimate:
    """A pair's estimate at the adjusted pose, with the other results of its own frames."""
    parent, child = (s.name for s in edge.sensors)
    observability = rig.observability(parent, child)
    others = [e.frames_used for p, e in solution.pairs.items() if p != own.pair]
    dt = {n: rig.poses.dt_s.get(n, 0.0) for n in (parent, child)}
    sigmas = [rig.sensors[n].dt_sigma_s for n in (parent, child) if n in rig.sensors]
    return replace(
        own,
        T=rig.poses.between(parent, child),
        covariance=rig.poses.covariance_between(parent, child),
        common_covariance=rig.poses.covariance_between(parent, child, common=True),
        observability=observability,
        observable=observability >= OBSERVABLE,
        frames_used=max(own.frames_used, min(others, default=0)),
        time_offset_s=dt[child] - dt[parent],
        time_offset_sigma_s=float(np.hypot.reduce(sigmas)),
    )


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
