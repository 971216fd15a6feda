"""Stage calibrate: observations of one vehicle-day to a calibration record per edge, and a pose per sensor."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import asdict
from typing import Any

from pipeline.calibrate.methods import Method, method_named
from pipeline.calibrate.records import (
    Inputs,
)
from pipeline.calibrate.rig_stage import refused_edges, rig_rows, three_rows
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.results import Outcome
from pipeline.core.stage_work import Records, Run, Task, Told, Work
from pipeline.rig.day_prior import prior_key
from pipeline.rig.edges import edge_of, words_of
from pipeline.rig.rig import Rig
from pipeline.store.moments import sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested, perceived
from schemas.calibrations import (
    SENSORS,
    STATUSES,
    CalibrationRecord,
    pairs_of,
)
from schemas.faults import FAULTS
from schemas.moments import SENSORS_ABSENT
from schemas.observations import WITHOUT_LABELS
from schemas.poses import PoseRow

__all__ = ["work"]

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
        "camera": _known_cameras(rig),
    } | rig.told_to_calibrate
    prior = rig.prior
    tables = (ingested, perceived) if method.needs_images else (perceived,)
    manifests = [manifest_of(task.lake, task.partition) for manifest_of in tables]

    def rows(run: Run) -> Generator[Records, None, None]:
        absent = _absent(task.lake, task.partition)
        about = Inputs(
            task.partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds), absent,
            probe_deg=task.probe_deg,
        )  # fmt: skip
        calibrated = rig_rows if method.name == "joint" else three_rows
        found: Sequence[CalibrationRecord | PoseRow]
        try:
            found = calibrated(task, about, run.progress)
        except SolveError as err:
            found = refused_edges(about, rig, err.reason, err.fault)
        yield Records(found)

    return Work(
        (fleet.select, fleet.trigger, fleet.solve, fleet.verify, prior, settings),
        rows,
        inputs=tuple(m.work_key for m in manifests if m is not None),
        tell=_told,
    )


def _known_cameras(rig: Rig) -> dict[str, Any]:
    """Assumed calibration of the rig's cameras, for the work key."""
    return {name: asdict(camera.known) for name, camera in rig.cameras.items()}


def _refusal(refused: Outcome, partition: Partition, method: Method, seed: int, rig: Rig) -> Work:
    """Records of a day that was refused before the solver, with the reason."""
    reason = f"{refused.stage}: {refused.reason}"

    def rows(run: Run) -> Generator[Records, None, None]:
        about = Inputs(partition, method.name, run.work_key, seed, run.inputs, pairs_of(rig.kinds))
        yield Records(refused_edges(about, rig, reason, *refused.faults))

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
            found[sensor] = f"{fault}most often {why}, {own[most]} times"
    for manifest in (told_before, told):
        found |= {} if manifest is None else manifest.extra.get(SENSORS_ABSENT, {})
    return found


def _told(records: Sequence[CalibrationRecord]) -> Told:
    counts = {status: sum(r.status == status for r in records) for status in STATUSES}
    unlabelled = [f"{r.parent_frame}: {WITHOUT_LABELS}" for r in records if WITHOUT_LABELS in r.notes]
    reasons = [f"{words_of(edge_of(r))}: {r.reason}" for r in records if r.reason]
    return Told(
        counts,
        dict(records[0].frames_rejected) if records else {},
        "; ".join(dict.fromkeys([*unlabelled, *reasons])),
        refused=counts["refused"] == len(records),
        faults=tuple(dict.fromkeys(fault for r in records for fault in r.faults)),
    )
