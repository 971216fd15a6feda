"""Records of a night: only the driver commits the workers' rows, in batches."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
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


# Commit order: a calibration's poses are committed before it, and outcomes come last. Columns that a night
# does not read.
_UNREAD = {
    POSES: ("inputs",),
    CALIBRATIONS: ("frames_rejected", "inputs"),
    OUTCOMES: ("rows", "kept", "rejected", "faults"),
}


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
        # Rows that are not committed yet, and recorded rows to become current again.
        self._new: dict[TableSchema, list[Any]] = {schema: [] for schema in _UNREAD}
        self._again: dict[TableSchema, list[Any]] = {schema: [] for schema in _UNREAD}
        self._committed_at = time.monotonic()
        days = sorted({p.day for p in partitions})
        # a night without vehicle-days needs no tables
        span = (days[0], days[-1]) if days else ("9999-12-31", "0001-01-01")
        self._recorded: dict[TableSchema, RecordIndex[Any]] = {
            schema: RecordIndex(lake, schema, schema.row_type, *span, unread)
            for schema, unread in _UNREAD.items()
        }

    def known(self, partition: Partition) -> Known:
        """Rows of a vehicle-day at the beginning of the night; the current one of a key comes last."""
        poses, records, outcomes = (
            index.of(partition.vehicle, partition.day) for index in self._recorded.values()
        )
        return Known((*records, *poses), tuple(outcomes))

    def add(self, outcome: Outcome, method: str) -> None:
        """Add an outcome and its records, and commit if it is time; on an OSError the rows are kept."""
        rows = [*outcome.records, outcome_row(outcome, method)]
        for schema in _UNREAD:
            if own := schema.rows_among(rows):
                self._sort(schema, own, self._recorded[schema].of(outcome.vehicle, outcome.day))
        waiting = sum(map(len, (*self._new.values(), *self._again.values())))
        if waiting >= _ROWS or (waiting and time.monotonic() - self._committed_at > _EVERY_S):
            self.commit()

    def _sort(self, schema: TableSchema, rows: Sequence[Any], recorded: Sequence[Any]) -> None:
        """Sort rows: unrecorded rows are new; recorded rows that were replaced become current again."""
        last = {schema.about_of(r): r.work_key for r in recorded}
        keys = {(schema.about_of(r), r.work_key) for r in recorded}
        for row in rows:
            about = schema.about_of(row)
            if (about, row.work_key) not in keys:
                self._new[schema].append(row)
            elif last[about] != row.work_key:
                self._again[schema].append(row)

    def commit(self) -> None:
        """Commit all waiting rows; on an OSError they are kept."""
        self._committed_at = time.monotonic()
        for schema in _UNREAD:
            for waiting, commit in ((self._new, commit_records), (self._again, assert_records)):
                if waiting[schema]:
                    commit(self._lake, schema, waiting[schema])
                    waiting[schema] = []


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
