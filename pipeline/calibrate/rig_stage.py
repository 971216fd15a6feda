"""Inputs of calibrate for a rig of several sensors of a kind: prior, views, edges, rows of each edge."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.methods import method_named
from pipeline.calibrate.pose_rows import pose_rows, poses_of_records
from pipeline.calibrate.prior_doubts import hold_doubted
from pipeline.calibrate.records import Inputs, refused_edge, refused_record
from pipeline.calibrate.rig_day import RigDay, calibrate_rig
from pipeline.calibrate.unlabelled import noted
from pipeline.calibrate.verify.target_accuracy import views_of
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress
from pipeline.core.stage_work import Task
from pipeline.rig.day_prior import prior_of_three, rig_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import Edge, edge_between
from pipeline.rig.overlap import FRAMES, Overlap, View, best_three, find_edges, overlaps_of
from pipeline.rig.prior import RigPrior, middle_of, moved
from pipeline.rig.rig import Rig
from pipeline.store.current import current_records, transform_of
from pipeline.store.moments import sensors_of
from pipeline.store.partitions import Lake, Partition, days_after
from pipeline.store.records import read_records
from pipeline.store.views import Chosen, observations_of, perceived
from schemas.calibrations import CALIBRATIONS, SENSORS, CalibrationRecord, pairs_of
from schemas.columns import POSE_COLUMNS
from schemas.moments import PRIOR
from schemas.observations import Observation
from schemas.poses import PoseRow

__all__ = ["accepted_before", "refused_edges", "rig_rows", "three_of_day", "three_rows", "three_sensors"]

# Days with records that are looked at: a vehicle that was held for longer has no state worth a look.
_DAYS_BACK = 10
# A vehicle that drives once a week has ten days in a quarter; older days are not read.
_CALENDAR_DAYS_BACK = 92


def rig_rows(task: Task, about: Inputs, progress: Progress) -> list[CalibrationRecord | PoseRow]:
    """Records of all edges of a vehicle-day, and a pose of each sensor; SolveError if none can be made."""
    fleet, rig = task.fleet, task.fleet.rig_of(task.partition.vehicle)
    day = _read(task, rig, about.seed)
    found = calibrate_rig(day, fleet, about, progress)
    before = replace(day.prior, reference=day.graph.reference).extrinsics()
    poses = pose_rows(about, day.graph, found.adjusted, before, day.views, fleet.verify, found.judged)
    poses, records = hold_doubted(poses, found.records)
    return [*records, *noted(poses, records)]


def three_rows(task: Task, about: Inputs, progress: Progress) -> list[CalibrationRecord | PoseRow]:
    """Records and poses of three sensors of the rig, by a method for one of each kind; errors as `three_of_day`."""
    chosen, prior = three_of_day(task, about.seed)
    rows, of_three = _rows(task, chosen), replace(about, chosen=chosen, pairs=pairs_of(chosen))
    try:
        solver = method_named(about.method).solver_of(task, chosen)
        records = calibrate_observations(rows, prior, task.fleet, of_three, progress, solver)
    except SolveError as err:
        records = [refused_record(of_three, pair, err, rows, prior, {}) for pair in of_three.pairs]
    return [*records, *poses_of_records(of_three, records)]


def three_of_day(task: Task, seed: int) -> tuple[Chosen, Prior]:
    """The three sensors that the task's method is run on, and their prior.

    Raises:
        SolveError: no three share a view, or the day has no prior.
    """
    rig = task.fleet.rig_of(task.partition.vehicle)
    prior, views = _known(task, rig, seed)
    chosen: Chosen = three_sensors(task.method or "joint", rig, overlaps_of(prior, views))
    return chosen, prior_of_three(prior, rig, *(chosen.get(kind) for kind in SENSORS))


def refused_edges(about: Inputs, rig: Rig, why: str, *faults: str) -> list[CalibrationRecord]:
    """Records of a day that could not be calibrated at all: of the edges that the rig names, else to the reference."""
    return [refused_edge(about, edge, why, 0, *faults) for edge in _expected_edges(rig)]


def _expected_edges(rig: Rig) -> tuple[Edge, ...]:
    named = rig.named_edges
    if named:
        return named
    nodes = [node for node in rig.nodes if node.kind != "base"]
    if len({n.kind for n in nodes}) == len(nodes):
        return tuple(edge_between(a, b) for a, b in combinations(nodes, 2))
    middle = next((n for n in nodes if n.name == rig.reference), middle_of(nodes))
    return tuple(edge_between(n, middle) for n in nodes if n.kind != middle.kind)


def _read(task: Task, rig: Rig, seed: int) -> RigDay:
    """Prior, views and edges of a vehicle-day."""
    prior, views = _known(task, rig, seed)
    nodes = {node.name: node for node in rig.nodes}
    graph = find_edges(
        prior,
        overlaps_of(prior, views),
        named=rig.named_edges,
        reference=None if rig.reference is None else nodes[rig.reference],
    )
    method = task.method or "joint"
    return RigDay(
        rig,
        graph,
        prior,
        views,
        _shared_rows(task),
        lambda edge: accepted_before(task.lake, task.partition, method, edge),
    )


def _known(task: Task, rig: Rig, seed: int) -> tuple[RigPrior, dict[str, View]]:
    """Prior and views of a vehicle-day."""
    manifest = perceived(task.lake, task.partition)
    if manifest is None:
        raise SolveError("no observations of this day: ingest or perceive refused it, or did not run")
    prior = rig_prior(manifest.extra.get(PRIOR, ()), task.fleet, rig)
    if task.perturb is not None:
        prior = moved(prior, float(np.radians(task.perturb[0])), task.perturb[1], seed)
    moments = np.unique(np.linspace(0, manifest.rows - 1, min(FRAMES, manifest.rows)).astype(int)).tolist()
    views = {
        name: view
        for name, kind in sensors_of(manifest).items()
        if (view := _view(task, {kind: name}, moments)) is not None
    }
    return prior, views


def _view(task: Task, chosen: Chosen, moments: Sequence[int]) -> View | None:
    [kind] = chosen
    rows = list(observations_of(task.lake, task.partition, moments, chosen))
    return views_of(rows).get(kind)


def _shared_rows(task: Task) -> Callable[[Chosen], list[Observation]]:
    """Reads rows of chosen sensors; what a sensor measured is held once, however many of its edges keep it."""
    known: dict[tuple[str, str, int], np.ndarray] = {}

    def shared(o: Observation, chosen: Chosen) -> Observation:
        same: dict[str, Any] = {}
        for one in fields(o):
            value = getattr(o, one.name)
            if isinstance(value, np.ndarray):
                sensor = chosen.get(one.name.partition("_")[0], chosen.get("camera", ""))
                first = known.setdefault((sensor, one.name, o.frame_index), value)
                if first is not value and first.dtype == value.dtype and np.array_equal(first, value):
                    same[one.name] = first
        return replace(o, **same)

    return lambda chosen: [shared(o, chosen) for o in _rows(task, chosen)]


def _rows(task: Task, chosen: Chosen) -> list[Observation]:
    return list(observations_of(task.lake, task.partition, chosen=chosen))


def accepted_before(
    lake: Lake, partition: Partition, method: str, edge: Edge
) -> Float[np.ndarray, "4 4"] | None:
    """T_parent_child of an edge on its latest earlier accepted day; None if there is none.

    It carries no information about today's pose and is no part of the work key: the search starts there only
    if the day alone does not decide, and the result is judged like any other.
    """
    found = read_records(
        lake,
        CALIBRATIONS,
        CalibrationRecord,
        vehicle=partition.vehicle,
        first=days_after(partition.day, -_CALENDAR_DAYS_BACK),
        last=days_after(partition.day, -1),
        columns=POSE_COLUMNS,
    )
    wanted = (edge.parent.name, edge.child.name, method, "accepted")
    records = current_records(found)
    days = sorted({r.day for r in records}, reverse=True)[:_DAYS_BACK]
    for record in reversed(records):
        if (
            record.day in days
            and (record.parent_frame, record.child_frame, record.method, record.status) == wanted
        ):
            return transform_of(record)
    return None


def three_sensors(method: str, rig: Rig, overlaps: Sequence[Overlap]) -> Mapping[str, str]:
    """Names by kind: those that the rig names, else the three with the largest overlap; else SolveError."""
    sensors = [node for node in rig.nodes if node.kind != "base"]
    only: Mapping[str, str] = {sensor.kind: sensor.name for sensor in sensors}
    if len(only) == len(sensors):
        return only
    named = rig.three or ()
    among = [o for o in overlaps if not named or {s.name for s in o.edge.sensors} <= set(named)]
    best = best_three(among)
    if best is None:
        which = "no three of the rig do"
        if named:
            which = f"{', '.join(named[:2])} and {named[2]} share none, name others as three of the rig"
        raise SolveError(f"method {method} works on a camera, a lidar and a radar that share a view: {which}")
    return {sensor.kind: sensor.name for sensor in best}
