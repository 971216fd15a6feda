"""A day of a rig: each edge from its own frames, then one adjustment over all edges.

An edge of two sensors is solved and judged like any pair. Its evidence without the prior enters the
adjustment; an edge that failed a check of its own is left out. Each edge is judged again at the adjusted poses, and
these are the result; what it found alone stands beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.rig import AdjustedRig
from pipeline.calibrate.adjusted_day import Concluded, SolvedEdge, adjusted_rig, conclude
from pipeline.calibrate.day import solve_day
from pipeline.calibrate.edges.camera_base import elsewhere
from pipeline.calibrate.edges.on_base import DaySources
from pipeline.calibrate.edges.sweep_travel import with_travel
from pipeline.calibrate.judging import EdgeJudging
from pipeline.calibrate.methods import Solver, method_named, resolved
from pipeline.calibrate.reasons import because
from pipeline.calibrate.records import Inputs, record_of_edge, refused_edge, refused_record
from pipeline.calibrate.verify.day_checks import far_positions, moved_failures, own_positions
from pipeline.core.config import ChecksConfig, FleetConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.objective.ego_motion import mean_heading, shown_heading
from pipeline.rig.day_prior import no_prior, prior_of_three
from pipeline.rig.estimates import Check, Prior, change_of
from pipeline.rig.graph import BASE, Edge, RigGraph, Sensor, pose_columns
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.overlap import View
from pipeline.rig.prior import Extrinsics, RigPrior
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import (
    change_between,
    change_covariance,
    change_jacobian,
    changed,
    inverse,
    log_se3,
    rotation_angle_rad,
)
from pipeline.store.views import Chosen
from schemas.calibrations import SENSORS, CalibrationRecord
from schemas.observations import Observation

__all__ = ["CalibratedRig", "RigDay", "WrongPrior", "calibrate_rig", "wrong_priors"]


# By lidar, azimuths in its axes in which the car drives straight on, with sigmas [rad].
Headings = Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True, eq=False)
class RigDay:
    """Data of a day for a rig.

    Args:
        views: view of each sensor, by name.
        rows: observations of chosen sensors, in order of time; read for each edge, and kept until it is judged at the
            adjusted poses.
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
        is_mounted = BASE in self.graph.sensors and not self.prior.is_base_loose
        T = self.prior.between(lidar, BASE.name) if is_mounted else None
        if found or T is None:
            return found
        return [(_azimuth(T), self.prior.sigmas_between(lidar, BASE.name)[0])]


@dataclass(frozen=True, eq=False)
class CalibratedRig:
    """Records of all edges, and the adjusted rig (None if no edge has evidence).

    Args:
        judged: what was concluded of the edges to the reference, by sensor.
        wrong: priors that edges contradict.
    """

    records: list[CalibrationRecord]
    adjusted: AdjustedRig | None
    judged: Mapping[str, Concluded]
    wrong: Sequence[WrongPrior] = ()


def calibrate_rig(
    day: RigDay, fleet: FleetConfig, about: Inputs, progress: Progress = silent, solver: Solver | None = None
) -> CalibratedRig:
    """Solve and judge each edge, then adjust poses and clocks of all sensors, unless the method is of three of them.

    `solver` is for methods that need more than observations (`Method.needs_images`); None = the method's own.
    """
    asked = day.graph.edges
    if not method_named(about.method).of_three:
        graph, known = with_travel(day.graph, day.prior, day.rows)
        day = replace(day, graph=graph, prior=known)
    logged, measured = day.prior, (day.rig.road_z_m, day.rig.measured_heights)
    sources = DaySources(logged, tuple(day.rig.lidars), tuple(day.rig.radars), day.rows, *measured)
    begun, far = (logged, {}) if method_named(about.method).of_three else _begun(day, sources, fleet)
    if far:
        day, sources = replace(day, prior=begun), replace(sources, prior=begun)
    found, done = _Found(), 0
    groups = sorted(_groups(day.graph), key=lambda g: KIND_OF_EDGE[g[0].kind].order)
    inner = progress if len(groups) == 1 else silent
    for group in groups:
        progress(done, len(day.graph.edges) + 1, ", ".join(edge.name for edge in group))
        done += len(group)
        if len(group) == 1 and day.prior.between(*(s.name for s in group[0].sensors)) is None:
            found.refused.append(refused_edge(about, group[0], no_prior(group[0].name), 0))
        elif not KIND_OF_EDGE[group[0].kind].solver:
            _solve_pairs(day, fleet, about, group, found, solver, inner)
        else:
            _solve_other(day, fleet, about, sources, group[0], found)
    progress(done, done + 1, "adjust the rig")
    against_prior = {e: [far[s.name] for s in e.edge.sensors if s.name in far] for e in found.edges}
    solved = [e.with_checks(checks) if checks else e for e, checks in against_prior.items()]
    edges, rig = _adjusted(day, fleet, about, solved)
    wrong = [] if rig is None else wrong_priors(edges, rig, fleet.verify.checks)
    concluded = conclude(edges, rig, lambda edge: _against(edge, rig, wrong))
    order = {(e.parent.name, e.child.name): k for k, e in enumerate(asked)}
    records = [*found.refused, *(c.record for c in concluded)]
    records = [r for r in records if (r.parent_frame, r.child_frame) in order]
    records.sort(key=lambda r: order[r.parent_frame, r.child_frame])
    records = [
        replace(r, **pose_columns(logged.between(r.parent_frame, r.child_frame), "prior_"))
        if far.keys() & {r.parent_frame, r.child_frame}
        else r
        for r in records
    ]
    middle = day.graph.reference
    to_middle = {c.edge.other(middle.name).name: c for c in concluded if middle in c.edge.sensors}
    return CalibratedRig(records, rig, to_middle, wrong)


def _begun(day: RigDay, sources: DaySources, fleet: FleetConfig) -> tuple[RigPrior, dict[str, Check]]:
    """Where the searches begin: the prior, but cameras beyond the search range of theirs where their motion shows them.

    Also the check that such a camera's edges fail, by its name: the prior stays the day's, and contradicts them.
    """
    prior, T, checks = day.prior, day.prior.T, dict[str, Check]()
    for edge in (e for e in day.graph.edges if e.kind == "camera_base"):
        name = edge.parent.name
        reach_rad = fleet.solve.search_range(prior.sigmas[name]).rotation_rad
        reach_rad = max(reach_rad, prior.sigmas[BASE.name][0] if prior.is_base_loose else 0.0)
        if (found := elsewhere(edge, sources, reach_rad)) is None:
            continue
        turn = inverse(sources.on_base(name)) @ found
        back = inverse(turn)
        T = {(a, b): back @ X if a == name else X @ turn if b == name else X for (a, b), X in T.items()}
        deg = float(np.degrees(rotation_angle_rad(turn)))
        checks[name] = Check(because("far camera", camera=name, deg=deg), _FAULT)
    return replace(prior, T=T), checks


def _against(edge: Edge, rig: AdjustedRig | None, wrong: Sequence[WrongPrior]) -> list[Check]:
    checks = [] if rig is None else [w.check(rig, edge) for w in wrong]
    return [check for check in checks if check is not None]


def _adjusted(
    day: RigDay, fleet: FleetConfig, about: Inputs, edges: Sequence[SolvedEdge]
) -> tuple[Sequence[SolvedEdge], AdjustedRig | None]:
    """Edges with what the whole rig shows of them, and the rig; None where the method's records are the answer."""
    if method_named(about.method).of_three:
        return edges, None
    prior = replace(day.prior, reference=day.graph.reference).extrinsics()
    parts = {e.edge: e.evidence.parts for e in edges if e.evidence.parts}
    moved = moved_failures(parts, day.graph.edges)
    edges = [_held_if_moved(e, moved.get(e.edge, ())) for e in edges]
    return edges, adjusted_rig(day.graph, prior, edges, fleet.solve.time_offset_sigma_s)


def _held_if_moved(edge: SolvedEdge, moved: Sequence[Check]) -> SolvedEdge:
    """The edge, held if other edges show that a sensor of it moved during the day."""
    return edge if not moved or "moved_in_day" in edge.judged.verdict.faults else edge.with_checks(moved)


@dataclass(frozen=True, eq=False)
class _Found:
    """Results so far: refused edges, solved ones, and directions of travel in axes of the lidars."""

    refused: list[CalibrationRecord] = field(default_factory=list)
    edges: list[SolvedEdge] = field(default_factory=list)
    headings: dict[str, list[tuple[float, float]]] = field(default_factory=dict)


def _groups(graph: RigGraph) -> list[tuple[Edge, ...]]:
    """Groups of edges solved from one reading: all pairs of a rig with one sensor of each kind, else single edges."""
    pairs = [edge for edge in graph.edges if not KIND_OF_EDGE[edge.kind].solver]
    sensors = {sensor for edge in pairs for sensor in edge.sensors}
    if not pairs or len({sensor.kind for sensor in sensors}) < len(sensors):
        return [(edge,) for edge in graph.edges]
    return [tuple(pairs), *((edge,) for edge in graph.edges if edge not in pairs)]


def _solve_pairs(
    day: RigDay,
    fleet: FleetConfig,
    about: Inputs,
    group: Sequence[Edge],
    found: _Found,
    solver: Solver | None,
    progress: Progress,
) -> None:
    chosen: Chosen = {sensor.kind: sensor.name for edge in group for sensor in edge.sensors}
    absent: dict[str, str] = {kind: about.absent[n] for kind, n in chosen.items() if n in about.absent}
    about = replace(about, pairs=tuple(edge.kind for edge in group), chosen=chosen, absent=absent)
    rows, prior = day.rows(chosen), day.prior_of(chosen, group, found.headings)
    try:
        refused, edges = solve_day(rows, prior, fleet, about, progress, solver)
    except SolveError as err:
        found.refused.extend(refused_record(about, pair, err, rows, prior, {}) for pair in about.pairs)
        return
    found.refused.extend(refused)
    found.edges.extend(edges)
    if len(edges) == len(group) == 1:
        _add_heading(edges[0], rows, found)


def _add_heading(edge: SolvedEdge, rows: Sequence[Observation], found: _Found) -> None:
    """Direction of travel by a radar's Doppler in a lidar's axes, if the radar's rotation is known."""
    if edge.edge.kind != "lidar_radar" or edge.evidence.checks or not edge.own.observable[2]:
        return
    heading = shown_heading(rows, edge.own.T)
    if heading is not None:
        sigma_rad = float(np.sqrt(edge.own.covariance[2, 2]))
        found.headings.setdefault(edge.edge.parent.name, []).append((heading, sigma_rad))


def _solve_other(
    day: RigDay, fleet: FleetConfig, about: Inputs, sources: DaySources, edge: Edge, found: _Found
) -> None:
    """Solve an edge that is not a pair of camera, lidar and radar."""
    try:
        shown, frames = resolved(KIND_OF_EDGE[edge.kind].solver)(edge, sources)
    except SolveError as err:
        found.refused.append(refused_edge(about, edge, err.reason, 0, err.fault))
        return
    judging = EdgeJudging.of(shown, day.prior, day.views, fleet)
    own = judging.estimate
    judged = judging.edge(own, shown.checks, False)
    evidence = replace(shown, checks=judged.verdict.against)
    record = partial(record_of_edge, about, judging, frames)
    found.edges.append(SolvedEdge(edge, own, judged, evidence, shown.checks, judging.edge, record))
    if edge.kind == "lidar_base" and not evidence.checks and not day.prior.is_base_loose:
        heading = _azimuth(own.T), float(np.sqrt(own.covariance[2, 2]))
        found.headings.setdefault(edge.parent.name, []).append(heading)


def _azimuth(T_lidar_base: Float[np.ndarray, "4 4"]) -> float:
    """Azimuth of the vehicle frame's x axis [rad]."""
    return float(np.arctan2(T_lidar_base[1, 0], T_lidar_base[0, 0]))


# --------------------------------------------------------------------------------------------------
# Wrong priors: mountings that edges contradict, and by how much all that rests on them would be off.
#
# An edge far from the prior is left out of the adjustment, because it may be in a wrong minimum. But if it is right,
# the prior of one of its sensors is wrong, and all that the day leaves to that prior errs with it, at the prior's small
# sigma: on a van whose reference lidar was logged .3 m too far ahead, three radars without a measured position were
# accepted half a degree off. Each of both sensors is suspected, unless another edge would show its error and does not.
# What a suspicion means for an edge or a pose follows from the derivative of the adjusted poses by the prior.

_FAULT = "prior"
_DENIES_SIGMAS = 3.0  # by which an edge's own change differs from the suspected one


@dataclass(frozen=True, eq=False)
class WrongPrior:
    """A sensor whose mounting an edge contradicts.

    Args:
        edge: shows it.
        shift: by which the prior's poses would be wrong (left perturbations, as in `Extrinsics`) [rad, m].
    """

    sensor: str
    edge: Edge
    shift: Float[np.ndarray, " P"]

    @property
    def sentence(self) -> str:
        """For what rests on it."""
        return because("prior wrong", sensor=self.sensor, edge=self.edge.name)

    def error(self, rig: AdjustedRig, a: str, b: str) -> Float[np.ndarray, " 6"]:
        """By how much T_a_b of the adjusted rig would be wrong, as left perturbation [rad, m]."""
        return np.asarray(rig.poses.jacobian_between(a, b) @ (rig.by_prior @ self.shift))

    def check(self, rig: AdjustedRig, edge: Edge) -> Check | None:
        """The check that an edge fails; None if it rests elsewhere: it would be off by less than a sigma."""
        a, b = (s.name for s in edge.sensors)
        T, covariance = rig.poses.between(a, b), rig.poses.covariance_between(a, b)
        error = change_jacobian(T) @ self.error(rig, a, b)
        if edge == self.edge or np.all(np.abs(error) <= np.sqrt(np.diag(change_covariance(T, covariance)))):
            return None
        return Check(self.sentence, _FAULT, error=change_of(error))


def wrong_priors(edges: Sequence[SolvedEdge], rig: AdjustedRig, limits: ChecksConfig) -> list[WrongPrior]:
    """Sensors whose prior an edge contradicts by many of its sigmas, and which no other edge acquits."""
    known = [e for e in edges if e.edge in rig.edges]
    found = []
    for accuser in known:
        if _FAULT not in accuser.judged.verdict.faults or accuser.own.disproved:
            continue
        T = _shown(accuser, rig.before, limits)
        for sensor in accuser.edge.sensors:
            shift = _shift(rig.before, accuser.edge, sensor, T)
            if not any(_denies(e, rig.before, shift, limits) for e in known if e is not accuser):
                found.append(WrongPrior(sensor.name, accuser.edge, shift))
    return found


def _shown(edge: SolvedEdge, before: Extrinsics, limits: ChecksConfig) -> Float[np.ndarray, "4 4"]:
    """The prior's transform, changed where the edge contradicts it."""
    T = before.between(*(s.name for s in edge.edge.sensors))
    step, far = change_between(T, edge.own.T), _far(edge.edge, before, limits)
    step = np.where(edge.own.observable & (np.abs(step) > far), step, 0.0)
    for k, shift in far_positions(edge.own, far / limits.max_move_prior_sigmas, limits).items():
        step[k] = shift
    return changed(T, step)


def _shift(
    before: Extrinsics, edge: Edge, sensor: Sensor, T: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " P"]:
    """By how much the prior's poses are wrong if the edge's transform is T and the sensor is mounted elsewhere."""
    parent, child = edge.sensors
    there = before.T[parent.name] @ T if sensor == child else before.T[child.name] @ inverse(T)
    xi, shift = log_se3(there @ inverse(before.T[sensor.name])), np.zeros(6 * len(before.order))
    if sensor == before.reference:  # all others are elsewhere to it
        return np.asarray(-np.tile(xi, len(before.order)))
    k = 6 * before.order.index(sensor.name)
    shift[k : k + 6] = xi
    return shift


def _denies(edge: SolvedEdge, before: Extrinsics, shift: np.ndarray, limits: ChecksConfig) -> bool:
    """Whether an edge would show so wrong a prior and does not."""
    a, b = (s.name for s in edge.edge.sensors)
    T = before.between(a, b)
    hidden = change_jacobian(T) @ before.jacobian_between(a, b) @ shift
    own, knows = change_between(T, edge.own.T), edge.own.observable.copy()
    sigma = np.sqrt(np.diag(change_covariance(edge.own.T, edge.own.covariance)))
    for k, (position, own_sigma) in own_positions(edge.own).items():
        own[k], sigma[k], knows[k] = position, own_sigma, True
    differs = np.abs(own - hidden) > np.maximum(0.5 * np.abs(hidden), _DENIES_SIGMAS * sigma)
    return bool(np.any(knows & differs & (np.abs(hidden) > _far(edge.edge, before, limits))))


def _far(edge: Edge, before: Extrinsics, limits: ChecksConfig) -> Float[np.ndarray, " 6"]:
    """Changes of an edge that contradict its prior."""
    a, b = (s.name for s in edge.sensors)
    covariance = change_covariance(before.between(a, b), before.covariance_between(a, b))
    return np.asarray(limits.max_move_prior_sigmas * np.sqrt(np.diag(covariance)))
