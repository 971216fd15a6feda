"""Records of a night: only the driver commits the workers' rows, in batches."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from pipeline.core.results import Outcome
from pipeline.store.commits import assert_records, commit_records
from pipeline.store.delta import open_table
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.records import RecordIndex
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.columns import TableSchema
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.poses import POSES, PoseRow
from schemas.versions import CODE_VERSION, TABLES

__all__ = ["Known", "Ledger", "outcome_row", "record_outcome"]

# A commit takes some tenths of a second: every half minute it costs a hundredth of the time. A killed night
# must repeat the calibrations of its last half minute.
_EVERY_S = 30.0
_ROWS = 3000


@dataclass(frozen=True)
class Known:
    """One vehicle-day in the lake: records (without columns that outcomes lack) and outcomes."""

    records: tuple[CalibrationRecord | PoseRow, ...] = ()
    outcomes: tuple[OutcomeRow, ...] = ()


@dataclass
class _Waiting:
    """Rows of one table that are not committed yet, and recorded rows to become current again."""

    schema: TableSchema
    new: list[Any] = field(default_factory=list)
    again: list[Any] = field(default_factory=list)


class Ledger:
    """Reads the lake's rows of a night's vehicle-days once, and commits the night's new rows.

    Raises:
        DamagedLogError: a table cannot be written to.
    """

    def __init__(self, lake: Lake, partitions: Sequence[Partition]) -> None:
        for schema in TABLES.values():
            if schema.is_record_table:
                open_table(lake, schema)  # reports an unwritable table before the night's work
        self._lake = lake
        # Commit order: a calibration's poses are committed before it, and outcomes come last.
        self._waiting = [_Waiting(t) for t in (POSES, CALIBRATIONS, OUTCOMES)]
        self._committed_at = time.monotonic()
        days = sorted({p.day for p in partitions})
        # a night without vehicle-days needs no tables
        span = (days[0], days[-1]) if days else ("9999-12-31", "0001-01-01")
        self._records = RecordIndex(
            lake, CALIBRATIONS, CalibrationRecord, *span, ("frames_rejected", "inputs")
        )
        self._poses = RecordIndex(lake, POSES, PoseRow, *span, ("inputs",))
        self._outcomes = RecordIndex(
            lake, OUTCOMES, OutcomeRow, *span, ("rows", "kept", "rejected", "faults")
        )

    def known(self, partition: Partition) -> Known:
        """Rows of a vehicle-day at the beginning of the night; the current one of a key comes last."""
        of = (partition.vehicle, partition.day)
        found = self._records.of(*of), self._poses.of(*of)
        return Known((*found[0], *found[1]), tuple(self._outcomes.of(*of)))

    def add(self, outcome: Outcome, method: str) -> None:
        """Add an outcome and its records, and commit if it is time; on an OSError the rows are kept."""
        poses, records, outcomes = self._waiting
        of = (outcome.vehicle, outcome.day)
        if outcome.records:
            _sort(poses, POSES.rows_among(outcome.records), self._poses.of(*of))
            _sort(records, CALIBRATIONS.rows_among(outcome.records), self._records.of(*of))
        _sort(outcomes, [outcome_row(outcome, method)], self._outcomes.of(*of))
        waiting = sum(len(w.new) + len(w.again) for w in self._waiting)
        if waiting >= _ROWS or (waiting and time.monotonic() - self._committed_at > _EVERY_S):
            self.commit()

    def commit(self) -> None:
        """Commit all waiting rows; on an OSError they are kept."""
        self._committed_at = time.monotonic()
        for waiting in self._waiting:
            if waiting.new:
                commit_records(self._lake, waiting.schema, waiting.new)
                waiting.new = []
            if waiting.again:
                assert_records(self._lake, waiting.schema, waiting.again)
                waiting.again = []


def record_outcome(lake: Lake, outcome: Outcome, method: str = "") -> None:
    """Record the outcome of a stage that was run by a command of its own."""
    commit_records(lake, OUTCOMES, [outcome_row(outcome, method)])


def outcome_row(outcome: Outcome, method: str) -> OutcomeRow:
    """Row of table `outcomes` for an outcome; `method` is of the calibration, empty for other stages."""
    effort = outcome.effort
    return OutcomeRow(
        vehicle=outcome.vehicle,
        day=outcome.day,
        stage=outcome.stage,
        method=method if outcome.stage == CALIBRATIONS.made_by else "",
        status="done" if outcome.status == "cached" else outcome.status,
        reason=outcome.reason,
        # A failure has no work key: the same failure gives the same row, however often it is tried.
        work_key=outcome.work_key or work_key(outcome.stage, CODE_VERSION, outcome.reason, []),
        rows=outcome.rows,
        kept=outcome.kept,
        rejected=outcome.rejected,
        began_at=effort.began_at,
        seconds=effort.seconds,
        bytes_read=effort.bytes_read,
        bytes_written=effort.bytes_written,
        code_version=CODE_VERSION,
        inputs=list(outcome.inputs),
        faults=list(outcome.faults),
    )


def _sort(waiting: _Waiting, rows: Sequence[Any], recorded: Sequence[Any]) -> None:
    """Sort rows: unrecorded rows are new; recorded rows that were replaced become current again."""
    about_of = waiting.schema.about_of
    last = {about_of(r): r.work_key for r in recorded}
    keys = {(about_of(r), r.work_key) for r in recorded}
    for row in rows:
        key = about_of(row)
        if (key, row.work_key) not in keys:
            waiting.new.append(row)
        elif last[key] != row.work_key:
            waiting.again.append(row)
