"""A day of a rig of any number of sensors: each edge by its own frames, then one adjustment over all of them.

An edge of two sensors is solved and judged as any pair is. What it finds enters the adjustment without its prior; an
edge that failed a check of its own is left out. The adjusted poses are the answer, the edges' records their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustmentLimits
from pipeline.calibrate.adjust.evidence import evidence_of
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.base_edges import BaseEdges
from pipeline.calibrate.edge_records import record_of_evidence, refused_edge
from pipeline.calibrate.records import Inputs, SolvedDay
from pipeline.calibrate.verify.constancy import moved_failures
from pipeline.config import FleetConfig
from pipeline.errors import SolveError
from pipeline.extrinsics.checks import FailedCheck, faults_of
from pipeline.extrinsics.estimates import PairEstimate, Prior
from pipeline.extrinsics.prior import no_prior, trio_prior
from pipeline.results import Progress
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, RigGraph
from pipeline.rig.prior import RigPrior
from pipeline.rig.rig import Rig
from pipeline.rig.views import View
from pipeline.store.views import Chosen
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["CalibratedRig", "RigDay", "calibrate_rig"]

PAIR_KINDS = ("camera_lidar", "camera_radar", "lidar_radar")  # estimated as pairs of three kinds of sensors

# Of one pair's frames: its records, and the day where it was computed.
_SolvePair = Callable[
    [Sequence[Observation], Prior, Inputs], tuple[list[CalibrationRecord], SolvedDay | None]
]


@dataclass(frozen=True, eq=False)
class RigDay:
    """What a day has of a rig.

    Args:
        rig: as fleet.toml has it.
        graph: its edges.
        prior: of all sensors.
        views: what each sensor sees, by name.
        rows: observations of chosen sensors, in order of time; read when an edge is solved, and let go after it.
    """

    rig: Rig
    graph: RigGraph
    prior: RigPrior
    views: Mapping[str, View]
    rows: Callable[[Chosen], list[Observation]]


@dataclass(frozen=True, eq=False)
class CalibratedRig:
    """Records of all edges, and the adjusted rig; None where no edge has evidence."""

    records: list[CalibrationRecord]
    adjusted: AdjustedRig | None


def calibrate_rig(
    day: RigDay, fleet: FleetConfig, about: Inputs, solve_pair: _SolvePair, progress: Progress
) -> CalibratedRig:
    """Solve and judge each edge, then adjust poses and clocks of all sensors.

    Args:
        day: of the rig.
        fleet: limits and effort.
        about: what identifies the records.
        solve_pair: selects, solves and judges one pair.
        progress: told about each edge.
    """
    records, evidence, clocks = list[CalibrationRecord](), list[EdgeEvidence](), dict[Edge, float]()
    estimates = dict[Edge, PairEstimate]()
    edges, others = (
        day.graph.edges,
        BaseEdges(day.prior, tuple(day.rig.lidars), tuple(day.rig.radars), day.rows),
    )
    for done, edge in enumerate(edges):
        progress(done, len(edges) + 1, f"calibrate {edge.name}")
        if day.prior.between(edge.parent.name, edge.child.name) is None:
            records.append(refused_edge(about, edge, no_prior(edge.name), 0))
            continue
        if edge.kind not in PAIR_KINDS:
            try:
                shown, frames = others.solve(edge)
            except SolveError as err:
                records.append(refused_edge(about, edge, err.reason, 0, err.fault))
                continue
            records.append(record_of_evidence(about, shown, day.prior, day.views, fleet, frames))
            evidence.append(shown)
            continue
        chosen: Chosen = {s.kind: s.name for s in edge.sensors}
        of_three = (chosen.get(kind) for kind in ("camera", "lidar", "radar"))
        prior = trio_prior(day.prior, day.rig, *of_three)
        absent: dict[str, str] = {
            s.kind: about.absent[s.name] for s in edge.sensors if s.name in about.absent
        }
        of_pair = replace(about, pairs=(edge.kind,), chosen=chosen, absent=absent)
        found, solved = solve_pair(day.rows(chosen), prior, of_pair)
        records += found
        if solved is not None:
            estimate = solved.solution.pairs[edge.kind]
            estimates[edge] = estimate
            evidence.append(
                evidence_of(estimate, edge, prior, fleet.solve.time_offset_sigma_s, _checks(solved, edge))
            )
            if estimate.time_offset_prior_s is not None:
                clocks[edge] = estimate.time_offset_prior_s
    progress(len(edges), len(edges) + 1, "adjust the rig")
    moved = moved_failures(estimates, edges)
    records = [_without_moved(r, moved.get(_edge_of(r, day.graph), ())) for r in records]
    evidence = [replace(e, checks=e.checks or tuple(moved.get(e.edge, ()))) for e in evidence]
    adjusted = _adjusted(day, evidence, clocks, fleet)
    return CalibratedRig([_with_innovation(r, day.graph, adjusted) for r in records], adjusted)


def _adjusted(
    day: RigDay, evidence: Sequence[EdgeEvidence], clocks: Mapping[Edge, float], fleet: FleetConfig
) -> AdjustedRig | None:
    if not evidence:
        return None
    prior = replace(day.prior, reference=day.graph.reference).extrinsics()
    known = [e for e in evidence if {s.name for s in e.edge.sensors} <= set(prior.T)]
    graph = _of_known(day.graph, prior)
    limits = AdjustmentLimits(fleet.solve.time_offset_sigma_s)
    return adjust(graph, replace(prior, dt_s=_expected_clocks(graph, clocks)), known, limits)


def _of_known(graph: RigGraph, prior: Extrinsics) -> RigGraph:
    """The graph of the sensors whose prior pose is known; without one nobody knows where to begin."""
    sensors = tuple(s for s in graph.sensors if s.name in prior.T)
    return RigGraph(sensors, tuple(e for e in graph.edges if set(e.sensors) <= set(sensors)), graph.reference)


def _expected_clocks(graph: RigGraph, clocks: Mapping[Edge, float]) -> dict[str, float]:
    """What is expected of each clock against the reference's, along the edges that time a sensor."""
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


def _checks(solved: SolvedDay, edge: Edge) -> list[FailedCheck]:
    """Why an edge's evidence is not to be used: its verdict, unless nothing but a wide sigma held it."""
    verdict = solved.judged[edge.kind].verdict
    if verdict.status == "accepted" or (verdict.status == "held" and verdict.unsure_only):
        return []
    return [FailedCheck(verdict.reason, verdict.faults[0] if verdict.faults else "")]


def _without_moved(record: CalibrationRecord, moved: Sequence[FailedCheck]) -> CalibrationRecord:
    """The record, held where a sensor of its edge moved during the day: as other edges show, it may not show it."""
    if not moved or record.status == "refused" or "moved_in_day" in record.faults:
        return record
    reason = "; ".join([*(check.sentence for check in moved), *([record.reason] if record.reason else [])])
    faults = [*record.faults, *faults_of(moved)]
    return replace(record, status="held", reason=reason, faults=faults, determined=[], mounting_determined=[])


def _edge_of(record: CalibrationRecord, graph: RigGraph) -> Edge:
    return Edge(graph[record.parent_frame], graph[record.child_frame])


def _with_innovation(
    record: CalibrationRecord, graph: RigGraph, adjusted: AdjustedRig | None
) -> CalibrationRecord:
    """The record with how far its edge is from what the others show, and whether the rig rests on it."""
    found = None if adjusted is None else adjusted.edges.get(_edge_of(record, graph))
    if found is None:
        return record
    return replace(record, innovation_sigmas=found.innovation_sigmas, believed=found.used)
