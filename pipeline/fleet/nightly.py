"""The night: every vehicle-day through the stages, then the audit of the fleet and the pages.

Vehicle-days are independent. A day that cannot be calibrated becomes a refused record with its reason, and an
error is reported in the outcome; neither stops the others. Running the night again repeats only days that
failed or whose inputs changed, because every stage returns "cached" for a known work key.
"""

# ruff: noqa: PTH100 (os.path.abspath leaves links alone and costs a microsecond)

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from pipeline.core.config import FleetConfig
from pipeline.core.errors import BoresightError
from pipeline.core.results import Effort, MadeWhenAsked, Outcome, Progress, silent
from pipeline.core.runner import try_stage, why_to_run
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE, INGEST, PERCEIVE
from pipeline.fleet.executor import EXECUTORS, Finished, Watch
from pipeline.fleet.ledger import Known, Ledger
from pipeline.fleet.pattern import VehicleDay
from pipeline.rig.graph import edge_of, words_of
from pipeline.store.partitions import Lake, Partition, last_possible_day
from schemas.calibrations import ASKS_FOR_FRAMES, CalibrationRecord
from schemas.moments import SWEEPS_LOGGED, SWEEPS_PLANNED
from schemas.words import day_word

__all__ = ["DayOutcome", "DayPlan", "Night", "asks_for_more", "plan_night", "refused_at_once", "run_night"]


@dataclass(frozen=True)
class Night:
    """Settings shared by all vehicle-days of a night."""

    fleet: FleetConfig
    lake: Lake
    method: str = "joint"
    seed: int | None = None


@dataclass(frozen=True)
class DayOutcome:
    """Result of a vehicle-day.

    `status`: a word of DAY_WORDS, or "cached" if all was done already. `mend`: what must be corrected in
    fleet.toml, in a file that it names, or in the recording; empty if nothing.
    """

    vehicle: str
    day: str
    status: str
    reason: str = ""
    stages: dict[str, str] = field(default_factory=dict)
    pairs: dict[str, str] = field(default_factory=dict)
    frames: int = 0
    trace: str = ""
    mend: str = ""
    results: tuple[Outcome, ...] = field(default=(), repr=False)  # of the stages, with the records to commit


_STAGES = (INGEST, PERCEIVE, CALIBRATE)
_NAMED = 5  # vehicles of fleet.toml named beside an unknown one
# Number of doublings: 1,600 sweeps at most, and all passes together cost seven times the first. Sigmas fall
# with the root of the number of frames in a calibration; if four times the choice does not help, more will
# not.
_MOST_TIMES_MORE = 2

# Configuration of the vehicle, the day with its logs, and its rows in the lake.
_Job = tuple[dict[str, Any], VehicleDay, Known]


def run_night(
    night: Night, days: Sequence[VehicleDay], executor: str, workers: int | None, watch: Watch
) -> Iterator[DayOutcome]:
    """Outcomes of vehicle-days in order of completion; unknown vehicles and future days are refused.

    Args:
        workers: processes or tasks at a time; None = as many as the executor finds CPUs for.
        watch: called with the progress of the i-th of the days known to fleet.toml.
    """
    why = [refused_at_once(night, day.partition) for day in days]
    known = [day for day, reason in zip(days, why, strict=True) if not reason]
    ledger = Ledger(night.lake, [day.partition for day in days])
    jobs, run = _jobs(night, known, ledger), partial(_run_job, _shared(night))
    refused = (
        _refused(night, day.partition, reason) for day, reason in zip(days, why, strict=True) if reason
    )
    try:
        with closing(EXECUTORS[executor](run, jobs, workers, watch)) as results:
            for outcome in chain(refused, map(_outcome, results)):
                for result in outcome.results:
                    with suppress(OSError):  # the storage may answer again before the night ends
                        ledger.add(result, night.method)
                yield outcome
    finally:
        ledger.commit()


def refused_at_once(night: Night, of: Partition) -> str:
    """Reason why logs cannot be of the vehicle and day in their path; empty if they can."""
    if of.day > last_possible_day():
        return f"{of.day} is in the future: correct the logs' path"
    if night.fleet.knows(of.vehicle):
        return ""
    has = ", ".join(
        get_close_matches(of.vehicle, night.fleet.vehicles) or list(night.fleet.vehicles)[:_NAMED]
    )
    add = f'add [vehicles."{of.vehicle}"] with its rig, or correct the logs\' path'
    return f"{night.fleet.file} has no vehicle {of.vehicle!r}; it has {has or 'none'}: {add}"


def _refused(night: Night, of: Partition, reason: str) -> DayOutcome:
    """Outcome of a vehicle-day that no stage is run on; an unknown vehicle is recorded, a wrong day is not."""
    refused = DayOutcome(of.vehicle, of.day, "refused", reason)
    if night.fleet.knows(of.vehicle) or of.day > last_possible_day():
        return refused
    result = Outcome(INGEST.name, of.vehicle, of.day, "refused", "", reason=reason, faults=("configuration",))
    return replace(refused, mend=reason, results=(result,))


def _run_job(night: Night, job: _Job, progress: Progress) -> DayOutcome:
    """Ingest, perceive and calibrate one vehicle-day; a refusal is a refused record.

    Its records are in the outcome, for the caller to commit.
    """
    own, work, known = job
    night = replace(night, fleet=night.fleet.model_copy(update=own))
    task = _task_of(night, work, known, progress)
    outcome = _through_stages(task, progress)
    damaged = next((r.damaged for r in outcome.results if r.damaged), "")
    if damaged:
        night.lake.set_aside(damaged)  # its inputs exist: make it again, once
        outcome = _through_stages(task, progress)
    for _ in range(_MOST_TIMES_MORE):
        if not asks_for_more(outcome.results):
            break
        wider = task.fleet.model_copy(update={"ingest": task.fleet.ingest.wider})
        task, before = replace(task, fleet=wider), outcome
        outcome = _through_stages(task, progress)
        outcome = replace(outcome, results=_with_efforts(before.results, outcome.results))
    return outcome


def asks_for_more(results: Sequence[Outcome]) -> bool:
    """Whether there are unread sweeps and a pair, or the whole day, lacks only frames."""
    read = next((r for r in results if r.stage == INGEST.name), None)
    if read is None or read.kept.get(SWEEPS_LOGGED, 0) <= read.kept.get(SWEEPS_PLANNED, 0):
        return False
    if any(r.status == "failed" for r in results):
        return False
    if any(r.status == "refused" for r in results if r.stage != CALIBRATE.name):
        return True
    # More frames may remove every clause of a reason.
    return any(
        all(any(words in clause for words in ASKS_FOR_FRAMES) for clause in r.reason.split("; "))
        for r in results[-1].records
        if r.status != "accepted"
    )


def _with_efforts(earlier: Sequence[Outcome], later: Sequence[Outcome]) -> tuple[Outcome, ...]:
    """The later results, with the effort of an earlier pass added to the same stages."""
    efforts = {r.stage: r.effort for r in earlier}
    return tuple(replace(r, effort=_sum(efforts.get(r.stage), r.effort)) for r in later)


def _sum(a: Effort | None, b: Effort) -> Effort:
    if a is None:
        return b
    read, written = (
        None if x is None or y is None else x + y
        for x, y in ((a.bytes_read, b.bytes_read), (a.bytes_written, b.bytes_written))
    )
    return Effort(a.began_at, a.seconds + b.seconds, read, written)


def _task_of(night: Night, work: VehicleDay, known: Known, progress: Progress = silent) -> Task:
    """Task of a vehicle-day for the stages; the caller commits the records."""
    return Task(
        night.fleet, night.lake, work.partition, night.method, night.seed, logs=tuple(work.logs),
        progress=progress, commit=False, recorded=tuple(r for r in known.records if r.method == night.method),
        before=known.outcomes,
    )  # fmt: skip


def _through_stages(task: Task, progress: Progress) -> DayOutcome:
    partition, done = task.partition, list[Outcome]()
    for stage in _STAGES:

        def named(done: int, total: int, what: str, name: str = stage.name) -> None:
            progress(done, total, f"{name} {what}")

        done.append(try_stage(stage, task, named))
        if done[-1].status == "failed":
            break
        if done[-1].status == "refused" and stage is not CALIBRATE:
            refusal = CALIBRATE.run(replace(task, given=done[-1]))  # records the refusal
            return replace(_summarise(partition, done), results=(*done, refusal))
    return replace(_summarise(partition, done), results=tuple(done))


def _jobs(night: Night, days: Sequence[VehicleDay], ledger: Ledger) -> Sequence[_Job]:
    """One job per vehicle-day for the workers, built on access."""

    def job(index: int) -> _Job:
        day, fleet = days[index], night.fleet
        vehicle = fleet.vehicle(day.partition.vehicle)
        own = {"vehicles": {day.partition.vehicle: vehicle}, "rigs": {vehicle.rig: fleet.rigs[vehicle.rig]}}
        # as in `_shared`; bucket addresses are valid everywhere
        logs = tuple(Path(os.path.abspath(g)) if isinstance(g, Path) else g for g in day.logs)
        return own, replace(day, logs=logs), ledger.known(day.partition)

    return MadeWhenAsked(len(days), job)


def _shared(night: Night) -> Night:
    """The night reduced for all workers: without vehicles' own configuration, and with absolute paths."""
    fleet = night.fleet.model_copy(update={"vehicles": {}, "rigs": {}})
    file = Path(os.path.abspath(night.fleet.file))  # keeps symbolic links in the path
    return replace(night, fleet=fleet.read_from(file), lake=night.lake.absolute())


def _outcome(finished: Finished[_Job, DayOutcome]) -> DayOutcome:
    if finished.value is not None:
        return finished.value
    partition = finished.item[1].partition
    return DayOutcome(partition.vehicle, partition.day, "failed", finished.error, trace=finished.trace)


def _summarise(partition: Partition, results: Sequence[Outcome]) -> DayOutcome:
    records = [r for r in results[-1].records if isinstance(r, CalibrationRecord)]
    pairs = {words_of(edge_of(r)): r.status for r in records}
    worst = next((r for r in results if r.status in ("failed", "refused")), None)
    status = worst.status if worst is not None else day_word(pairs.values()) if pairs else "done"
    if status == "done" and all(r.status == "cached" for r in results):
        status = "cached"
    return DayOutcome(
        partition.vehicle,
        partition.day,
        status,
        worst.reason if worst else next((r.reason for r in results if r.stage == CALIBRATE.name), ""),
        {r.stage: r.status for r in results},
        pairs,
        next((r.rows for r in results if r.stage == INGEST.name), 0),
        mend=next((r.reason for r in results if "configuration" in r.faults), ""),
    )


# The plan of a night (`--dry-run`): the stages that would run, and why.


@dataclass(frozen=True)
class DayPlan:
    """Stages that would run on a vehicle-day, in order, and the reason of the first; none = up to date."""

    vehicle: str
    day: str
    stages: tuple[str, ...]
    why: str


def plan_night(night: Night, days: Sequence[VehicleDay]) -> Iterator[DayPlan]:
    """The plan of every vehicle-day, in order; logs are read only to identify their content.

    If a stage's new result equals the old one, the stages after it turn out to be up to date.
    """
    known = [d for d in days if not refused_at_once(night, d.partition)]
    ledger = Ledger(night.lake, [d.partition for d in known])
    for day in days:
        vehicle, date = day.partition.vehicle, day.partition.day
        why_not = refused_at_once(night, day.partition)
        if why_not:
            yield DayPlan(vehicle, date, (), f"{why_not}: refused")
            continue
        task = _task_of(night, day, ledger.known(day.partition))
        try:
            yield DayPlan(vehicle, date, *_would_run(task))
        except (BoresightError, OSError) as err:
            yield DayPlan(vehicle, date, (), f"would fail: {err}")


def _would_run(task: Task) -> tuple[tuple[str, ...], str]:
    for at, stage in enumerate(_STAGES):
        before = next((r for r in reversed(task.before) if r.stage == stage.name), None)
        why = why_to_run(stage, task)
        if why:
            failed = f", failed before: {before.reason}" if before and before.status == "failed" else ""
            return tuple(s.name for s in _STAGES[at:]), why + failed
        if before is not None and before.status == "refused" and stage is not CALIBRATE:
            return (), f"refused by {stage.name}: {before.reason}"
    return (), "up to date"
