"""Stage calibrate: observations of one vehicle-day to a calibration record per edge, and a pose per sensor."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.methods import Method, method_named
from pipeline.calibrate.pose_rows import pose_rows, poses_of_records
from pipeline.calibrate.reasons import because
from pipeline.calibrate.records import Inputs, refused_edge
from pipeline.calibrate.rig_day import RigDay, calibrate_rig
from pipeline.calibrate.verify.target_accuracy import views_of
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.results import Outcome, Progress
from pipeline.core.stage_work import Run, Task, Told, Work
from pipeline.rig.day_prior import prior_key, prior_of_three, rig_prior
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import Edge, RigGraph, Sensor, edge_between, edge_of, words_of
from pipeline.rig.overlap import FRAMES, Overlap, View, best_three, find_edges, overlaps_of
from pipeline.rig.prior import RigPrior, middle_of, moved
from pipeline.rig.rig import Rig
from pipeline.store.current import current_records, transform_of
from pipeline.store.moments import sensors_of
from pipeline.store.partitions import Lake, Partition, days_after
from pipeline.store.records import read_records
from pipeline.store.views import Chosen, ingested, observations_of, perceived
from schemas.calibrations import CALIBRATIONS, SENSORS, STATUSES, CalibrationRecord, pairs_of
from schemas.columns import POSE_COLUMNS
from schemas.faults import FAULTS
from schemas.moments import PRIOR, SENSORS_ABSENT
from schemas.observations import WITHOUT_LABELS, Observation
from schemas.poses import PoseRow

__all__ = ["accepted_before", "noted", "refused_edges", "three_of_day", "three_sensors", "work"]

# Days with records that are looked at: a vehicle that was held for longer has no state worth a look.
_DAYS_BACK = 10
# A vehicle that drives once a week has ten days in a quarter; older days are not read.
_CALENDAR_DAYS_BACK = 92
_UNLABELLED = (
    "labels_missing",
    "detections_missing",
)  # reasons of perceive's manifest: the image is not at fault


def work(task: Task) -> Work:
    """The records of a vehicle-day, one per pair.

    A day that cannot be calibrated, or that an earlier stage refused, gets refused records with the reason.

    Raises:
        ConfigError: no such vehicle, method or network, or an impossible seed or prior file.
    """
    method, fleet = method_named(task.method or "joint"), task.fleet
    seed = fleet.solve.seed if task.seed is None else task.seed
    if seed < 0:
        raise ConfigError("command line", "seed", f"{seed} is less than 0")
    rig = fleet.rig_of(task.partition.vehicle)
    if task.given is not None:
        return _refusal(task.given, task.partition, method, seed, rig)
    settings = {"method": method.name} | method.settings_of(task)
    settings |= {
        "perturb": task.perturb,
        "seed": seed,
        "prior_file": prior_key(fleet, task.partition.vehicle),
        "camera": {name: asdict(camera.known) for name, camera in rig.cameras.items()},
    } | rig.told_to_calibrate
    prior = rig.prior
    tables = (ingested, perceived) if method.needs_images else (perceived,)
    manifests = [manifest_of(task.lake, task.partition) for manifest_of in tables]

    def rows(run: Run) -> Generator[Any, None, None]:
        absent = _absent(task.lake, task.partition)
        about = Inputs(
            task.partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds), absent,
            probe_deg=task.probe_deg,
        )  # fmt: skip
        found: Sequence[CalibrationRecord | PoseRow]
        try:
            found = _rows_of_day(task, about, run.progress)
        except SolveError as err:
            found = refused_edges(about, rig, err.reason, err.fault)
        yield from found

    return Work(
        (fleet.select, fleet.trigger, fleet.solve, fleet.verify, prior, settings),
        rows,
        inputs=tuple(m.work_key for m in manifests if m is not None),
        tell=_told,
    )


def _refusal(refused: Outcome, partition: Partition, method: Method, seed: int, rig: Rig) -> Work:
    """Records of a day that was refused before the solver, with the reason."""
    reason = f"{refused.stage}: {refused.reason}"

    def rows(run: Run) -> Generator[Any, None, None]:
        about = Inputs(partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds))
        yield from refused_edges(about, rig, reason, *refused.faults)

    inputs = (refused.work_key,) if refused.work_key else ()
    # Recorded each time: an older record of a day that was not refused then must not pass for the current one.
    return Work(({"refused": reason, "method": method.name},), rows, inputs, tell=_told, again=True)


def _absent(lake: Lake, partition: Partition) -> dict[str, str]:
    """Reasons why frames lack a sensor, from the manifests of perceive and ingest."""
    told, told_before = perceived(lake, partition), ingested(lake, partition)
    found, counts = {}, {} if told is None else told.rejected
    for sensor in SENSORS if told is None else (*SENSORS, *sensors_of(told)):
        own = {name: n for name, n in counts.items() if name.startswith(f"without_{sensor}_")}
        if own:
            most = max(own, key=lambda name: own[name])
            why = most.removeprefix(f"without_{sensor}_")
            fault = f"{FAULTS['no_labels']}, {sensor}: " if why in _UNLABELLED else ""
            found[sensor] = fault + because("cause", cause=why, times=own[most])
    for manifest in (told_before, told):
        found |= {} if manifest is None else manifest.extra.get(SENSORS_ABSENT, {})
    return found


def _told(records: Sequence[CalibrationRecord]) -> Told:
    counts = {status: sum(r.status == status for r in records) for status in STATUSES}
    unlabelled = [f"{r.parent_frame}: {WITHOUT_LABELS}" for r in records if WITHOUT_LABELS in r.notes]
    reasons = [f"{words_of(edge_of(r))}: {r.reason}" for r in records if r.reason and r.status != "accepted"]
    return Told(
        counts,
        dict(records[0].frames_rejected) if records else {},
        "; ".join(dict.fromkeys([*unlabelled, *reasons])),
        refused=counts["refused"] == len(records),
        faults=tuple(dict.fromkeys(fault for r in records for fault in r.faults)),
    )


def _rows_of_day(task: Task, about: Inputs, progress: Progress) -> list[CalibrationRecord | PoseRow]:
    """Records of edges of a vehicle-day, and a pose of each sensor; SolveError if none can be made."""
    fleet, method = task.fleet, method_named(about.method)
    day = _read(task, about.seed, method)
    if method.of_three:
        chosen = _by_kind(day.graph.sensors)
        about = replace(about, chosen=chosen, pairs=pairs_of(chosen))
        solver = method.solver_of(task, chosen)
        records = calibrate_rig(day, fleet, about, progress, solver).records
        return [*records, *poses_of_records(about, records)]
    found = calibrate_rig(day, fleet, about, progress)
    before = replace(day.prior, reference=day.graph.reference).extrinsics()
    rig, views = found.adjusted, day.views
    poses = pose_rows(about, day.graph, rig, before, views, fleet.verify, found.judged, found.wrong)
    return [*found.records, *noted(poses, found.records)]


def noted(poses: Sequence[PoseRow], records: Sequence[CalibrationRecord]) -> list[PoseRow]:
    """The poses, with the note of cameras whose records state that they have no labels."""
    unlabelled = {r.parent_frame for r in records if WITHOUT_LABELS in r.notes}
    return [
        replace(row, notes=[WITHOUT_LABELS, *row.notes]) if row.sensor in unlabelled else row for row in poses
    ]


def three_of_day(task: Task, seed: int) -> tuple[Chosen, Prior]:
    """The three sensors that the task's method is run on, and their prior.

    Raises:
        SolveError: no three share a view, or the day has no prior.
    """
    day = _read(task, seed, method_named(task.method or "joint-ssl"))
    chosen = _by_kind(day.graph.sensors)
    return chosen, prior_of_three(day.prior, day.rig, *(chosen.get(kind) for kind in SENSORS))


def _by_kind(sensors: Iterable[Sensor]) -> Chosen:
    return {sensor.kind: sensor.name for sensor in sensors}


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


def _read(task: Task, seed: int, method: Method) -> RigDay:
    """Prior, views and edges of a vehicle-day; of a method of three sensors, their pairs."""
    rig = task.fleet.rig_of(task.partition.vehicle)
    prior, views = _known(task, rig, seed)
    overlaps = overlaps_of(prior, views)
    if method.of_three:
        three = tuple(three_sensors(method.name, rig, overlaps))
        graph = RigGraph(three, tuple(edge_between(*two) for two in combinations(three, 2)), middle_of(three))
        return RigDay(rig, graph, prior, views, lambda chosen: _rows(task, chosen))
    nodes = {node.name: node for node in rig.nodes}
    reference = None if rig.reference is None else nodes[rig.reference]
    graph = find_edges(prior, overlaps, named=rig.named_edges, reference=reference)
    before = partial(accepted_before, task.lake, task.partition, method.name)
    known: dict[str, list[Any]] = {}  # a sensor is read and held once, however many of its edges keep it
    return RigDay(rig, graph, prior, views, lambda chosen: _rows(task, chosen, known), before)


def _known(task: Task, rig: Rig, seed: int) -> tuple[RigPrior, dict[str, View]]:
    """Prior and views of a vehicle-day."""
    manifest = perceived(task.lake, task.partition)
    if manifest is None:
        raise SolveError(because("no observations"))
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


def _rows(task: Task, chosen: Chosen, known: dict[str, list[Any]] | None = None) -> list[Observation]:
    return list(observations_of(task.lake, task.partition, chosen=chosen, known=known))


def accepted_before(
    lake: Lake, partition: Partition, method: str, edge: Edge
) -> Float[np.ndarray, "4 4"] | None:
    """T_parent_child of an edge on its latest earlier accepted day; None if there is none.

    It carries no information about today's pose and is no part of the work key: the search starts there only
    if the day alone does not decide, and the result is judged like any other.
    """
    found = read_records(
        lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle,
        first=days_after(partition.day, -_CALENDAR_DAYS_BACK), last=days_after(partition.day, -1),
        columns=POSE_COLUMNS,
    )  # fmt: skip
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


def three_sensors(method: str, rig: Rig, overlaps: Sequence[Overlap]) -> Sequence[Sensor]:
    """One of each kind: those that the rig names, else the three with the largest overlap; else SolveError."""
    sensors = [node for node in rig.nodes if node.kind != "base"]
    if len({sensor.kind for sensor in sensors}) == len(sensors):
        return sensors
    named = rig.three or ()
    among = [o for o in overlaps if not named or {s.name for s in o.edge.sensors} <= set(named)]
    best = best_three(among)
    if best is None:
        which = because("no three")
        if named:
            which = because("not these", some=", ".join(named[:2]), last=named[2])
        raise SolveError(because("needs three", method=method, why=which))
    return best
