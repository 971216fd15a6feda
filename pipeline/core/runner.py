"""Run a stage on a task: the steps around every stage.

The steps: work key, check for finished work, inputs, the stage itself, atomic commit, manifest with counts,
outcome. Every executor runs this code: in the same process, in a pool, or on another machine.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

from pipeline.core.config import config_hash
from pipeline.core.errors import BoresightError, ContractError, DamagedError, TooMuchMemoryError
from pipeline.core.memory import at_most
from pipeline.core.results import Outcome, Progress, measured
from pipeline.core.stage_work import NothingUsable, Run, Task, Window, Work
from pipeline.store.commits import assert_records, commit_last, commit_records
from pipeline.store.moments import MomentWriter, is_whole, write_moments
from pipeline.store.partitions import Partition, work_key
from pipeline.store.records import read_records
from pipeline.store.tables import Manifest, absence, read_manifest, write_partition
from schemas.columns import TableSchema
from schemas.moments import STATED_FAULTS
from schemas.versions import CODE_VERSION

__all__ = ["Stage", "try_stage", "why_to_run"]


@dataclass(frozen=True)
class Stage:
    """One step of the nightly run.

    Args:
        writes: table that it writes, then the tables of sensors that belong to it; empty if it writes files.
        function: import path of `work(task) -> Work`.
        needs_inputs: True if a missing input table is an error. False if the stage reads what the task's
            method needs and handles missing tables itself.
        per_vehicle_day: False if it works on all vehicles and days of a window.
    """

    name: str
    reads: tuple[TableSchema, ...]
    writes: tuple[TableSchema, ...]
    function: str
    needs_inputs: bool = True
    per_vehicle_day: bool = True

    def load(self) -> Callable[[Task], Work]:
        """Import the stage's module and return its function."""
        module, name = self.function.split(":")
        function: Callable[[Task], Work] = getattr(importlib.import_module(module), name)
        return function

    def run(self, task: Task) -> Outcome:
        """Run the task unless the same work is done already.

        Equal code version, settings and inputs give an equal work key; a partition or record with that key is
        not made again ("cached"). If a stage raises or is killed, tables stay as they were.

        Raises:
            ConfigError: unknown vehicle, or a configuration that the stage refuses.
            ContractError: an input table of the vehicle-day is missing, or a row breaks the contract of its
                table.
        """
        with measured() as effort:
            task, work, run = _prepared(self, task)
            if not self.writes:  # it writes each file atomically itself, and yields its path
                with closing(work.rows(run)) as paths:
                    outcome = _outcome(self, task, "done", run.work_key, outputs=[str(p) for p in paths])
            elif self.writes[0].is_record_table:
                outcome = _add_records(self, task, work, run)
            else:
                outcome = _replace_partition(self, task, work, run)
        return replace(outcome, inputs=run.inputs, effort=effort())


def why_to_run(stage: Stage, task: Task) -> str:
    """Reason to run a stage of a vehicle-day that writes a table; empty if its work is done already."""
    task, work, run = _prepared(stage, task)
    schema = stage.writes[0]
    if _refused_before(stage, task, run) is not None:
        return ""
    if schema.is_record_table:
        own = schema.rows_among(task.recorded or ())
        made = [(r.work_key, r.code_version, tuple(r.inputs)) for r in own]
    else:
        done = _readable(task, schema)
        made = [(done.work_key, done.code_version, tuple(done.inputs))] if done is not None else []
    if {run.work_key, *_wider_keys(stage, work, run)} & {key for key, _, _ in made}:
        return ""
    if not made:
        return f"no {schema.name} yet"
    _, version, inputs = made[-1]
    if version != CODE_VERSION:
        return f"{schema.name} are of version {version}, this is {CODE_VERSION}"
    return "other configuration" if sorted(inputs) == sorted(run.inputs) else "other inputs"


def _prepared(stage: Stage, task: Task) -> tuple[Task, Work, Run]:
    """The task with its inputs, the stage's work for it, and the run with its work key."""
    if isinstance(task.of, Partition):
        task.fleet.rig_of(task.of.vehicle)
    if stage.per_vehicle_day and stage.needs_inputs:
        task = replace(task, inputs=_inputs(stage, task))
    work = stage.load()(task)
    known = tuple(m.work_key for m in task.inputs.values())
    inputs = known if work.inputs is None else work.inputs
    key = work_key(stage.name, CODE_VERSION, config_hash(*work.settings), list(inputs))
    return task, work, Run(key, inputs, task.progress)


def _wider_keys(stage: Stage, work: Work, run: Run) -> list[str]:
    """Work keys of the same inputs under settings that produce a superset of this work."""
    return [work_key(stage.name, CODE_VERSION, config_hash(*s), list(run.inputs)) for s in work.wider]


def try_stage(stage: Stage, task: Task, progress: Progress) -> Outcome:
    """`Stage.run` with errors turned into outcomes, so that one vehicle-day never stops the others."""
    with measured() as effort:
        try:
            return stage.run(replace(task, progress=progress))
        except (BoresightError, OSError) as err:
            damaged = err.path if isinstance(err, DamagedError) else ""
            told = {
                "faults": ("configuration",)
                if getattr(err, "exit_code", 1) == 2
                else getattr(err, "faults", ()),
                "damaged": damaged,
                "effort": effort(),
            }
            return _outcome(stage, task, "failed", "", reason=str(err), **told)


def _inputs(stage: Stage, task: Task) -> dict[str, Manifest]:
    """Manifests of all tables that the stage reads, in order of `stage.reads`."""
    found = {}
    for schema in (s for s in stage.reads if not s.of_sensor):
        manifest = read_manifest(task.lake, schema, task.partition)
        if manifest is None:
            problem = absence(schema, task.partition)
            raise ContractError(str(task.lake.folder(schema.name, task.partition)), problem)
        found[schema.name] = manifest
    return found


def _replace_partition(stage: Stage, task: Task, work: Work, run: Run) -> Outcome:
    """Write the rows into the partition, which appears as a whole or not at all."""
    schema = stage.writes[0]
    done = _readable(task, schema)
    keys = (run.work_key, *_wider_keys(stage, work, run))
    if done is not None and done.work_key in keys and not work.again:
        # The same remarks again: if the night that made the partition was killed, they were never printed.
        return _partition_outcome(stage, task, work, "cached", done)
    refused = _refused_before(stage, task, run)
    if refused is not None:
        return refused
    write = write_moments if any(s.of_sensor for s in stage.writes) else write_partition
    try:
        with (
            at_most(task.fleet.fleet.memory_gb),
            closing(work.rows(run)) as rows,
            write(task.lake, schema, task.partition, run.work_key, run.inputs) as out,
        ):
            if isinstance(out, MomentWriter):
                for moment, captures in rows:
                    out.append(moment, captures)
            else:
                for row in rows:
                    out.add(row)
            counts = {"kept": {"frames": out.rows, **run.kept}, "rejected": dict(run.rejected)}
            out.describe(**counts, remarks=run.remarks, **run.extra)
    except (NothingUsable, TooMuchMemoryError) as refusal:
        counts = {"kept": {"frames": 0, **run.kept}, "rejected": dict(run.rejected)}
        told = counts | {"reason": str(refusal), "faults": refusal.faults}
        return _outcome(stage, task, "refused", run.work_key, **told)
    written = read_manifest(task.lake, schema, task.partition)
    assert written is not None, "the partition was just written"
    return _partition_outcome(stage, task, work, "done", written)


def _refused_before(stage: Stage, task: Task, run: Run) -> Outcome | None:
    """Outcome of an earlier refusal of the same inputs, if any: they would be refused again."""
    too_much = str(TooMuchMemoryError(task.fleet.fleet.memory_gb))  # a larger limit may be enough
    for row in task.before:
        if "memory" in row.faults and row.reason != too_much:
            continue
        if (row.stage, row.status, row.work_key) == (stage.name, "refused", run.work_key):
            counts = {"rows": row.rows, "kept": row.kept, "rejected": row.rejected}
            told = counts | {"reason": row.reason, "faults": tuple(row.faults)}
            return _outcome(stage, task, "refused", run.work_key, **told)
    return None


def _readable(task: Task, schema: TableSchema) -> Manifest | None:
    """Manifest of the partition; None if absent, of another version or damaged: to be made anew."""
    try:
        found = read_manifest(task.lake, schema, task.partition)
        return found if found is None or is_whole(task.lake, task.partition, found) else None
    except (ContractError, ValueError, OSError):
        return None


def _partition_outcome(stage: Stage, task: Task, work: Work, status: str, manifest: Manifest) -> Outcome:
    reason = manifest.remarks
    if manifest.rows == 0:
        status = "refused"
        counts = ", ".join(f"{n} {why}" for why, n in sorted(manifest.rejected.items()))
        reason = f"{work.nothing}: {counts}" if counts else "the day has no frames"
    return _outcome(
        stage, task, status, manifest.work_key, rows=manifest.rows, kept=dict(manifest.kept),
        rejected=dict(manifest.rejected), reason=reason, faults=tuple(manifest.extra.get(STATED_FAULTS, ())),
        outputs=[str(task.lake.folder(manifest.table, task.partition))],
    )  # fmt: skip


def _add_records(stage: Stage, task: Task, work: Work, run: Run) -> Outcome:
    """Record work that is not recorded yet; commit it here unless the task's owner does."""
    recorded = [] if work.again else [r for r in _recorded(stage, task) if r.work_key == run.work_key]
    if stage.writes[0].rows_among(recorded):
        if task.commit:
            for schema in stage.writes:
                assert_records(task.lake, schema, schema.rows_among(recorded))
        return _record_outcome(stage, task, work, "cached", run.work_key, recorded)
    with at_most(task.fleet.fleet.memory_gb), closing(work.rows(run)) as rows:
        written = list(rows)
    if task.commit:
        # The first table is committed last: if its rows are there, the rows of the other tables are too.
        for schema in reversed(stage.writes):
            is_said_of_all = isinstance(task.of, Window) and schema is stage.writes[0]
            commit = commit_last if is_said_of_all else commit_records
            commit(task.lake, schema, schema.rows_among(written))
    return _record_outcome(stage, task, work, "done", run.work_key, written)


def _recorded(stage: Stage, task: Task) -> Sequence[Any]:
    """Records of the vehicle-day in the tables of the stage."""
    if task.recorded is not None:
        return task.recorded
    vehicle, day = task.partition.vehicle, task.partition.day
    found: list[Any] = []
    for schema in stage.writes:
        of_day: list[Any] = read_records(task.lake, schema, schema.row_type, vehicle=vehicle, day=day)
        found += of_day
    return found


def _record_outcome(stage: Stage, task: Task, work: Work, status: str, key: str, rows: list[Any]) -> Outcome:
    own = stage.writes[0].rows_among(rows)
    told = work.tell(own)
    return _outcome(
        stage, task, "refused" if told.refused and status == "done" else status, key, rows=len(own),
        kept=told.kept, rejected=told.rejected, reason=told.reason, faults=told.faults,
        outputs=[task.lake.table(t.name) for t in stage.writes if t.rows_among(rows)], records=tuple(rows),
    )  # fmt: skip


def _outcome(stage: Stage, task: Task, status: str, key: str, **told: Any) -> Outcome:
    of = task.of
    where = (of.vehicle, of.day) if isinstance(of, Partition) else ("", "")
    return Outcome(stage.name, *where, status, key, **told)
