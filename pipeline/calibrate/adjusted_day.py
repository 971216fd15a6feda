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
from pipeline.rig.changes import change_between, change_covariance
from pipeline.rig.checks import Change, FailedCheck, change_of
from pipeline.rig.estimates import PairEstimate, Solution
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, RigGraph
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["adjusted_rig", "clocks_of", "evidence_of_day", "judged_together"]

_SIGMAS = 3.0  # by which an edge that is left out contradicts the rest
_SCATTER = 1.5  # sigmas of a difference that is no contradiction


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
            pairs[pair], verdicts[pair] = estimate, again
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
    doubts = rig.edges[edge].doubts
    found = (
        {", ".join(e.name for e in doubts): [e for e in doubts if not rig.edges[e].used]} if doubts else {}
    )
    for other, at in rig.edges.items():
        if other == edge or at.used or other in doubts or any(c.disproves for c in at.evidence.checks):
            continue
        if (at.innovation_sigmas or 0.0) > _SIGMAS:
            found[f"{other.name} and the other edges"] = [other]
    estimates = {edges[pair]: estimate for pair, estimate in day.solution.pairs.items()}
    return [
        FailedCheck(
            f"{who} contradict each other and nothing tells which is wrong",
            "witnesses_disagree",
            error=_error(edge, out, rig, estimates, adjusted),
        )
        for who, out in found.items()
    ]


def _error(
    edge: Edge,
    out: Sequence[Edge],
    rig: AdjustedRig,
    estimates: Mapping[Edge, PairEstimate],
    adjusted: PairEstimate,
) -> Change | None:
    """Change of the edge's pose if the one edge that the rig does without is right; None if nobody knows.

    Only in what the two poses differ by more than the scatter of both: a radar's edge to the camera may
    contradict its roll and know little of its azimuth.
    """
    found = estimates.get(out[0]) if len(out) == 1 else None
    around = None if found is None else _around(edge, out[0], rig)
    if found is None or around is None:
        return None
    before, after, is_turned = around
    T, covariance = (inverse(found.T), _of_inverse(found)) if is_turned else (found.T, found.covariance)
    A = adjoint(before)
    if_right, of_right = before @ T @ after, A @ covariance @ A.T
    change = change_between(adjusted.T, if_right)
    both = change_covariance(if_right, of_right) + change_covariance(adjusted.T, adjusted.covariance)
    return change_of(np.where(np.abs(change) > _SCATTER * np.sqrt(np.diag(both)), change, 0.0))


def _of_inverse(estimate: PairEstimate) -> Float[np.ndarray, "6 6"]:
    A = adjoint(inverse(estimate.T))
    return A @ estimate.covariance @ A.T


def _around(
    edge: Edge, out: Edge, rig: AdjustedRig
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"], bool] | None:
    """Poses before and after an edge that is left out, on the way along it from the parent to the child of another.

    The last is true where it is passed from its child to its parent. None if no edges in use lead there.
    """
    used = tuple(e for e, at in rig.edges.items() if at.used and e not in (edge, out))
    sensors = {s for e in rig.edges for s in e.sensors}
    graph = RigGraph(tuple(sensors), used, edge.parent)
    for is_turned in (False, True):
        first, last = out.sensors[::-1] if is_turned else out.sensors
        if graph.path(edge.parent, first) is not None and graph.path(last, edge.child) is not None:
            between = rig.poses.between
            return between(edge.parent.name, first.name), between(last.name, edge.child.name), is_turned
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
