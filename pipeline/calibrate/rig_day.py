"""A day of a rig: each edge from its own frames, then one adjustment over all edges.

An edge of two sensors is solved and judged like any pair. Its evidence without the prior enters the
adjustment; an edge that failed a check of its own is left out. The adjusted poses are the result. For a rig
with one sensor of each kind, whose frames are loaded together, records have the adjusted poses too; otherwise
they have each edge's own evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.adjusted import AdjustedRig
from pipeline.calibrate.adjusted_day import adjusted_rig, clocks_of, evidence_of_day, judged_together
from pipeline.calibrate.day import DayOfPairs, records_of, solve_day
from pipeline.calibrate.edges.day_sources import DaySources
from pipeline.calibrate.judging import judged_edge
from pipeline.calibrate.methods import resolved
from pipeline.calibrate.records import Inputs, record_of_edge, refused_edge, refused_record
from pipeline.calibrate.verify.constancy import moved_failures
from pipeline.core.config import FleetConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress
from pipeline.objective.ego_motion import mean_heading, shown_heading
from pipeline.rig.checks import FailedCheck, faults_of
from pipeline.rig.day_prior import no_prior, prior_of_three
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.graph import BASE, Edge, RigGraph
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.overlap import View
from pipeline.rig.prior import RigPrior
from pipeline.rig.rig import Rig
from pipeline.store.views import Chosen
from schemas.calibrations import SENSORS, CalibrationRecord
from schemas.observations import Observation

__all__ = ["CalibratedRig", "RigDay", "calibrate_rig"]


# By lidar, azimuths in its axes in which the car drives straight on, with sigmas [rad].
Headings = Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True, eq=False)
class RigDay:
    """Data of a day for a rig.

    Args:
        views: view of each sensor, by name.
        rows: observations of chosen sensors, in order of time; read for each edge, and then released.
        before: T_parent_child of an edge from an earlier day; None if there is none.
    """

    rig: Rig
    graph: RigGraph
    prior: RigPrior
    views: Mapping[str, View]
    rows: Callable[[Chosen], list[Observation]]
    before: Callable[[Edge], Float[np.ndarray, "4 4"] | None] = lambda _: None

    def prior_of(self, chosen: Chosen, edges: Sequence[Edge], headings: Headings) -> Prior:
        """Prior of up to one camera, one lidar and one radar, with the direction of travel in the lidar's axes."""
        prior = prior_of_three(self.prior, self.rig, *(chosen.get(kind) for kind in SENSORS))
        prior = replace(prior, T_base_radar=self.prior.between(BASE.name, chosen.get("radar", "")))
        at = next((e for e in edges if e.kind == "camera_lidar"), None)
        if at is None:
            return prior
        heading = mean_heading(self._mounted(at.child.name, headings))
        return replace(prior, T_camera_lidar_before=self.before(at), heading=heading)

    def _mounted(self, lidar: str, headings: Headings) -> Sequence[tuple[float, float]]:
        """Headings in a lidar's axes; from its mounting on the vehicle frame if the day does not determine one."""
        found = headings.get(lidar, [])
        T = self.prior.between(lidar, BASE.name) if BASE in self.graph.sensors else None
        if found or T is None:
            return found
        return [(_azimuth(T), self.prior.sigmas_between(lidar, BASE.name)[0])]


@dataclass(frozen=True, eq=False)
class CalibratedRig:
    """Records of all edges, and the adjusted rig (None if no edge has evidence).

    `judged` has the records of edges to the reference that were judged at the adjusted poses, by sensor.
    """

    records: list[CalibrationRecord]
    adjusted: AdjustedRig | None
    judged: Mapping[str, CalibrationRecord]


def calibrate_rig(day: RigDay, fleet: FleetConfig, about: Inputs, progress: Progress) -> CalibratedRig:
    """Solve and judge each edge, then adjust poses and clocks of all sensors."""
    measured = day.rig.road_z_m, day.rig.measured_heights
    sources = DaySources(day.prior, tuple(day.rig.lidars), tuple(day.rig.radars), day.rows, *measured)
    found, done = _Found(), 0
    for group in sorted(_groups(day.graph), key=lambda g: KIND_OF_EDGE[g[0].kind].order):
        progress(done, len(day.graph.edges) + 1, f"calibrate {', '.join(edge.name for edge in group)}")
        done += len(group)
        if len(group) == 1 and day.prior.between(*(s.name for s in group[0].sensors)) is None:
            found.records.append(refused_edge(about, group[0], no_prior(group[0].name), 0))
        elif not KIND_OF_EDGE[group[0].kind].solver:
            _solve_pairs(day, fleet, about, group, found)
        else:
            _solve_other(day, fleet, about, sources, group[0], found)
    progress(done, done + 1, "adjust the rig")
    prior = replace(day.prior, reference=day.graph.reference).extrinsics()
    sigma_s = fleet.solve.time_offset_sigma_s
    moved = moved_failures({e.edge: e.parts for e in found.evidence if e.parts}, day.graph.edges)
    records = [_without_moved(r, moved.get(_edge_of(r, day.graph), ())) for r in found.records]
    evidence = [replace(e, checks=e.checks or tuple(moved.get(e.edge, ()))) for e in found.evidence]
    rig = adjusted_rig(day.graph, prior, evidence, found.clocks, sigma_s)
    judged = list[CalibrationRecord]()
    for of_pairs, solved, edges in found.together:
        assert solved.solved is not None
        again = judged_together(solved.solved, rig, edges)
        judged += records_of(of_pairs, replace(solved, solved=again))
    records += judged
    order = {(e.parent.name, e.child.name): k for k, e in enumerate(day.graph.edges)}
    records.sort(key=lambda r: order[r.parent_frame, r.child_frame])
    ends = {frozenset((r.parent_frame, r.child_frame)): r for r in judged}
    middle = day.graph.reference.name
    to_middle = {s.name: ends[key] for s in day.graph.sensors if (key := frozenset((s.name, middle))) in ends}
    records = [_with_innovation(r, day.graph, rig) for r in records]
    return CalibratedRig(records, rig, to_middle)


@dataclass(frozen=True, eq=False)
class _Found:
    """Results of edges so far: concluded records, evidence, and days to judge at the adjusted poses."""

    records: list[CalibrationRecord] = field(default_factory=list)
    evidence: list[EdgeEvidence] = field(default_factory=list)
    clocks: dict[Edge, float] = field(default_factory=dict)
    estimates: dict[Edge, PairEstimate] = field(default_factory=dict)
    headings: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    together: list[tuple[Inputs, DayOfPairs, Mapping[str, Edge]]] = field(default_factory=list)


def _groups(graph: RigGraph) -> list[tuple[Edge, ...]]:
    """Groups of edges solved from one reading: all pairs of a rig with one sensor of each kind, else single edges."""
    pairs = [edge for edge in graph.edges if not KIND_OF_EDGE[edge.kind].solver]
    sensors = {sensor for edge in pairs for sensor in edge.sensors}
    if not pairs or len({sensor.kind for sensor in sensors}) < len(sensors):
        return [(edge,) for edge in graph.edges]
    return [tuple(pairs), *((edge,) for edge in graph.edges if edge not in pairs)]


def _solve_pairs(
    day: RigDay, fleet: FleetConfig, about: Inputs, group: Sequence[Edge], found: _Found
) -> None:
    chosen: Chosen = {sensor.kind: sensor.name for edge in group for sensor in edge.sensors}
    absent: dict[str, str] = {kind: about.absent[n] for kind, n in chosen.items() if n in about.absent}
    about = replace(about, pairs=tuple(edge.kind for edge in group), chosen=chosen, absent=absent)
    rows, prior = day.rows(chosen), day.prior_of(chosen, group, found.headings)
    try:
        solved = solve_day(rows, prior, fleet, about)
    except SolveError as err:
        found.records.extend(refused_record(about, pair, err, rows, prior, {}) for pair in about.pairs)
        return
    if solved.solved is None:
        found.records.extend(records_of(about, solved))
        return
    edges = {edge.kind: edge for edge in group if edge.kind in solved.solved.solution.pairs}
    found.evidence.extend(evidence_of_day(solved.solved, edges, fleet))
    found.clocks.update(clocks_of(solved.solved, edges))
    found.estimates.update({edges[pair]: e for pair, e in solved.solved.solution.pairs.items()})
    if len(group) > 1:
        found.together.append((about, solved, edges))
        return
    found.records.extend(records_of(about, solved))
    _add_heading(group[0], rows, found)


def _add_heading(edge: Edge, rows: Sequence[Observation], found: _Found) -> None:
    """Direction of travel by a radar's Doppler in a lidar's axes, if the radar's rotation is known."""
    estimate, evidence = found.estimates[edge], found.evidence[-1]
    if edge.kind != "lidar_radar" or evidence.checks or not estimate.observable[2]:
        return
    heading = shown_heading(rows, estimate.T)
    if heading is not None:
        sigma_rad = float(np.sqrt(estimate.covariance[2, 2]))
        found.headings.setdefault(edge.parent.name, []).append((heading, sigma_rad))


def _solve_other(
    day: RigDay, fleet: FleetConfig, about: Inputs, sources: DaySources, edge: Edge, found: _Found
) -> None:
    """Solve an edge that is not a pair of camera, lidar and radar."""
    try:
        shown, frames = resolved(KIND_OF_EDGE[edge.kind].solver)(edge, sources)
    except SolveError as err:
        found.records.append(refused_edge(about, edge, err.reason, 0, err.fault))
        return
    judged = judged_edge(shown, day.prior, day.views, fleet)
    found.records.append(record_of_edge(about, judged, frames))
    found.evidence.append(judged.evidence)
    if edge.kind == "lidar_base" and not judged.evidence.checks:
        estimate = judged.estimate
        heading = _azimuth(estimate.T), float(np.sqrt(estimate.covariance[2, 2]))
        found.headings.setdefault(edge.parent.name, []).append(heading)


def _azimuth(T_lidar_base: Float[np.ndarray, "4 4"]) -> float:
    """Azimuth of the vehicle frame's x axis [rad]."""
    return float(np.arctan2(T_lidar_base[1, 0], T_lidar_base[0, 0]))


def _without_moved(record: CalibrationRecord, moved: Sequence[FailedCheck]) -> CalibrationRecord:
    """The record, held if other edges show that a sensor of its edge moved during the day."""
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
    """The record with the innovation of its edge, and whether the rig uses the edge."""
    found = None if adjusted is None else adjusted.edges.get(_edge_of(record, graph))
    if found is None:
        return record
    return replace(record, innovation_sigmas=found.innovation_sigmas, used=found.used)
