"""Check of the calibrations of a data set: every log is verified, as shipped and with known turns."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipeline.config import FleetConfig, config_hash
from pipeline.errors import BoresightError
from pipeline.extrinsics.prior import prior_key
from pipeline.results import Outcome, Progress
from pipeline.rig.prior import RigPrior
from pipeline.rigs import OnnxSemantics, TopicSemantics
from pipeline.stage_work import Task
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.remote_logs import LogPath
from pipeline.store.views import observations_of
from pipeline.verify.axes import answers_by_sensor, probes
from pipeline.verify.faults import Fault, copy_with_fault, faults_of_log
from pipeline.verify.one_axis import AxisCheck
from pipeline.verify.one_log import check_poses, check_sensors, prior_in_use, with_prior
from pipeline.verify.shared_errors import passes_of, reads_of
from pipeline.verify.turns import Turn, turns_of_log
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES
from schemas.set_checks import SET_CHECKS, SetCheck
from schemas.versions import CODE_VERSION

__all__ = [
    "NO_ANSWER",
    "LogJob",
    "SetSettings",
    "ask_log",
    "ask_set",
    "is_complete",
    "key_of_log",
]

# Answers about a log that has none for any sensor; those of _AGAIN are not recorded, the next run tries again.
NO_ANSWER = ("unreadable", "no rig", "unusable", "no calibration")
_AGAIN = NO_ANSWER[:2]
_EVERY_S = 30.0  # between two commits

Run = Callable[[Task], Outcome]
# (function, items, workers, watch) -> results with `item`, `value` and `error`, as pipeline/fleet/executor.py has them.
Executor = Callable[..., Any]


@dataclass(frozen=True)
class SetSettings:
    """Settings shared by all logs.

    Args:
        fleet: configuration for one look at a log (`for_one_look`).
        asked_deg: errors of camera-lidar, and of pairs with the radar, that must be detected.
        sizes: sizes of the turns, as multiples of these errors.
        turns: number of turns per log.
        faults: number of faults per log.
        stages: ingest, perceive and calibrate.
    """

    fleet: FleetConfig
    asked_deg: tuple[float, float]
    sizes: tuple[float, ...]
    turns: int
    faults: int
    stages: tuple[Run, Run, Run]


@dataclass(frozen=True)
class LogJob:
    """One log, or all logs of a vehicle-day together: identity of their content (hexadecimal), recorded rows.

    `make` writes the log, which is then deleted after its answer; None = the log exists.
    """

    vehicle: str
    day: str
    logs: tuple[LogPath, ...]
    identity: str
    key: str = ""
    done: tuple[SetCheck, ...] = ()
    make: Callable[[Path], object] | None = None

    @property
    def row(self) -> SetCheck:
        """A row without an answer."""
        return SetCheck(
            vehicle=self.vehicle, day=self.day, log=str(self.logs[0]), answer="", work_key=self.key,
            code_version=CODE_VERSION,
        )  # fmt: skip


def key_of_log(settings: SetSettings, job: LogJob) -> str:
    """Work key of a log: content, configuration, models and the file of the calibration, without the turns."""
    fleet = settings.fleet
    rig = fleet.rig_of(job.vehicle)
    models = [
        hashlib.sha256(fleet.path_of(name).read_bytes()).hexdigest()
        for camera in rig.cameras.values()
        if isinstance(camera.semantics, OnnxSemantics)
        for name in (camera.semantics.segmenter, camera.semantics.detector)
    ]
    told: dict[str, Any] = {
        "asked": (settings.asked_deg, probes(settings.asked_deg, settings.sizes)),
        "file": prior_key(fleet, job.vehicle),
        "models": models,
    }
    told |= {
        "edges": rig.edges,
        "reference": rig.reference,
        "base": rig.base,
        "calibrate": rig.told_to_calibrate,
    }
    sections = (fleet.ingest, fleet.perceive, fleet.select, fleet.trigger, fleet.solve, fleet.verify, rig)
    return work_key("verify-set", CODE_VERSION, config_hash(*sections, told), [job.identity])


def ask_set(
    settings: SetSettings,
    jobs: Sequence[LogJob],
    folder: Lake,
    executor: Executor,
    workers: int | None,
    watch: Callable[[int, int, int, str], None],
) -> Iterator[tuple[LogJob, list[SetCheck]]]:
    """Each log with its rows, in order of completion; rows are committed during the run.

    Only the turns that a log lacks are checked. Do not pass complete logs (`is_complete`).
    """
    waiting, committed_at = list[SetCheck](), time.monotonic()
    try:
        with closing(executor(partial(ask_log, settings), jobs, workers, watch)) as results:
            for finished in results:
                job: LogJob = finished.item
                rows = finished.value or [replace(job.row, answer=NO_ANSWER[0], reason=finished.error)]
                waiting += [row for row in rows if row.answer not in _AGAIN and not row.recorded_at]
                if time.monotonic() - committed_at > _EVERY_S:
                    commit_records(folder, SET_CHECKS, waiting)
                    waiting, committed_at = [], time.monotonic()
                yield job, rows
    finally:
        commit_records(folder, SET_CHECKS, waiting)


def ask_log(settings: SetSettings, job: LogJob, progress: Progress) -> list[SetCheck]:
    """Rows of a log for the calibration as shipped and for every turn; rows recorded earlier come first."""
    fleet = settings.fleet
    if not fleet.knows(job.vehicle):
        why = f"{fleet.file} has no vehicle {job.vehicle!r}"
        return [replace(job.row, answer="no rig", reason=why)]
    with TemporaryDirectory(prefix="boresight-set-") as temporary:
        lake, partition = Lake.at(Path(temporary) / "lake"), Partition(job.vehicle, job.day)
        probe_deg = probes(settings.asked_deg, settings.sizes)
        task = Task(
            fleet,
            lake,
            partition,
            "joint",
            probe_deg=probe_deg,
            logs=job.logs,
            progress=progress,
            commit=False,
        )
        try:
            if job.make is not None:
                progress(0, 0, "convert")
                made = Path(temporary) / f"{job.logs[0].name}.mcap"
                job.make(made)
                task = replace(task, logs=(made,))
            for run in settings.stages[:2]:
                outcome = run(task)
                if outcome.status == "refused":
                    return [replace(job.row, answer="unusable", reason=f"{outcome.stage}: {outcome.reason}")]
            return _asked(settings, job, task)
        except (BoresightError, OSError) as err:
            return [replace(job.row, answer="unreadable", reason=str(err))]


def is_complete(settings: SetSettings, job: LogJob) -> bool:
    """Whether all rows of a log are recorded."""
    if not job.done:
        return False
    if job.done[0].answer in NO_ANSWER:
        return True
    shipped = [_check_of(row) for row in job.done if not row.turn]
    wanted = turns_of_log(shipped, settings.sizes, settings.turns, job.identity)
    names = {t.name for t in wanted} | {f.name for f in _faults(settings, job, job.done)}
    return names <= {row.turn for row in job.done}


def _faults(settings: SetSettings, job: LogJob, rows: Sequence[SetCheck]) -> list[Fault]:
    """Faults to add to a log, of sensors that its own answer is about or refers to."""
    rig = settings.fleet.rig_of(job.vehicle)
    asked = {r.sensor for r in rows if not r.turn and r.sigma_rad is not None}
    lidars = [n.name for n in rig.nodes if n.kind == "lidar"]
    about = asked | {n for n in lidars if asked and (n == rig.reference or len(lidars) == 1)}
    labelled = any(isinstance(c.semantics, TopicSemantics) for c in rig.cameras.values())
    sensors = [n for n in rig.nodes if n.name in about]
    return faults_of_log(sensors, settings.faults, job.identity, labelled=labelled)


def _check_of(row: SetCheck) -> AxisCheck:
    """The part of a check that `turns_of_log` reads."""
    nan = float("nan")
    numbers = (nan, nan, row.limit_rad or nan, row.asked_rad or nan, 0.0, nan)
    return AxisCheck(row.sensor, row.kind, row.axis, row.status, row.reason, *numbers)


def _asked(settings: SetSettings, job: LogJob, task: Task) -> list[SetCheck]:
    """Rows of a perceived log."""
    prior = prior_in_use(task.fleet, task.lake, task.partition)
    kept = set() if prior is None else {n.name for n in prior.nodes if n not in prior.untied}
    if prior is None or len(kept) < 2:
        why = "no transform between any two of its sensors, in tf_static or in a file that fleet.toml names"
        return [replace(job.row, answer="no calibration", reason=why)]
    rig = task.fleet.rig_of(job.vehicle)
    task = replace(task, fleet=task.fleet.with_rig(job.vehicle, rig.of_sensors(kept)))
    looked = _Look(settings, job, task, prior, rig.is_one_of_each)
    rows = list(job.done) or looked.rows(None)
    shipped = [_check_of(row) for row in rows if not row.turn]
    turns = turns_of_log(shipped, settings.sizes, settings.turns, job.identity)
    missing = [t for t in turns if t.name not in {row.turn for row in rows}]
    for turn in missing:
        rows += looked.rows(turn)
    for fault in _faults(settings, job, rows):
        if fault.name not in {row.turn for row in rows}:
            rows += looked.rows_with(fault)
    return rows


@dataclass(frozen=True, eq=False)
class _Look:
    """A perceived log with the calibration that it ships."""

    settings: SetSettings
    job: LogJob
    task: Task
    prior: RigPrior
    one_of_each: bool

    def rows_with(self, fault: Fault) -> list[SetCheck]:
        """Rows with a fault in the log's data, which is perceived again."""
        with TemporaryDirectory(prefix="boresight-fault-") as folder:
            asked_rad = float(np.radians(self.settings.asked_deg[0]))
            faulty = replace(self.task, lake=Lake.at(folder))
            copy_with_fault(self.task.lake, self.task.partition, fault, asked_rad, faulty.lake)
            self.settings.stages[1](faulty)
            return replace(self, task=faulty).rows(fault)

    def rows(self, turn: Turn | Fault | None) -> list[SetCheck]:
        """Rows of the shipped calibration, turned or not, or with a fault in the log's data."""
        turned = {turn.sensor: turn.transform()} if isinstance(turn, Turn) else {}
        fleet = with_prior(self.task.fleet, self.task.lake, self.job.vehicle, self._tied, turned)
        outcome = self.settings.stages[2](replace(self.task, fleet=fleet))
        records: list[CalibrationRecord] = CALIBRATIONS.rows_among(outcome.records)
        poses, verify, asked = POSES.rows_among(outcome.records), fleet.verify, self.settings.asked_deg
        prior = prior_in_use(fleet, self.task.lake, self.task.partition)
        if self.one_of_each:
            checks = check_sensors(records, verify, asked)
            checks += check_poses([], prior, self.prior.untied, verify, asked)
        else:
            checks = check_poses(poses, prior, self.prior.untied, verify, asked, records)
        answers, base = answers_by_sensor(checks), self._base(turn)
        kinds, edges = {n.name: n.kind for n in self.prior.nodes}, {p.sensor: p.edges for p in poses}
        frame = next(observations_of(self.task.lake, self.task.partition, [0]), None)
        of_camera = {r.parent_frame: r for r in records if r.pair == "camera_lidar"}
        return [
            replace(
                base, sensor=c.pair, kind=c.kind, axis=c.axis, status=c.status, reason=c.reason,
                answer=answers[c.pair], off_rad=_known(c.off_rad), sigma_rad=_known(c.sigma_rad),
                limit_rad=c.limit_rad, asked_rad=c.asked_rad, power=c.power, shown_rad=_known(c.shown_rad),
                signed_rad=_known(c.signed_rad), common_rad=c.common_rad, beyond=c.beyond,
                held_out_z={f"{deg:+g}": z for deg, z in c.held_out_z.items()},
                reads=reads_of(c.kind, edges.get(c.pair, []), kinds),
                passes_rad=passes_of(of_camera.get(c.pair), frame),
            )
            for c in checks
        ]  # fmt: skip

    @property
    def _tied(self) -> RigPrior:
        nodes = tuple(n for n in self.prior.nodes if n not in self.prior.untied)
        names = {n.name for n in nodes}
        return replace(self.prior, nodes=nodes, T={e: T for e, T in self.prior.T.items() if set(e) <= names})

    def _base(self, turn: Turn | Fault | None) -> SetCheck:
        """Fields common to all rows of one look."""
        rig = self.task.fleet.vehicle(self.job.vehicle).rig
        about = replace(self.job.row, rig=rig, shipped=_hash_of(self._tied))
        if turn is None:
            return about
        if isinstance(turn, Fault):
            return replace(about, turn=turn.name, turn_sensor=turn.sensor, fault=turn.words)
        return replace(about, turn=turn.name, turn_sensor=turn.sensor, turn_axis=turn.axis, turn_deg=turn.deg)


def _hash_of_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _hash_of(prior: RigPrior) -> str:
    """Hash of poses rounded to .1 mm and 1e-4; logs that ship the same calibration have the same hash."""
    poses = prior.extrinsics().T
    numbers = {name: np.round(T, 4).tolist() for name, T in sorted(poses.items())}
    return _hash_of_text(json.dumps(numbers))


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
