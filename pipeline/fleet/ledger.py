"""What a night records: the driver commits the workers' rows in batches, so that workers share nothing."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from pipeline.results import Outcome
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import assert_records, commit_records, read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord

__all__ = ["Ledger"]

# A commit takes some tenths of a second. Every half minute is one hundredth of the time, and what a killed night has to
# calibrate again is what ended in the last half minute.
_EVERY_S = 30.0
_ROWS = 3000


class Ledger:
    """Reads once what the lake has of a night's vehicle-days, and commits what the night adds.

    Args:
        lake: where the tables are.
        partitions: the night's vehicle-days.
    """

    def __init__(self, lake: Lake, partitions: Sequence[Partition]) -> None:
        self._lake = lake
        self._recorded: dict[tuple[str, str], list[CalibrationRecord]] = defaultdict(list)
        self._new: list[Any] = []
        self._again: list[Any] = []
        self._committed_at = time.monotonic()
        days = sorted({p.day for p in partitions})
        if days:
            columns = ("frames_rejected",)  # besides the columns that every record has: what an outcome says
            found = read_records(
                lake, CALIBRATIONS, CalibrationRecord, first=days[0], last=days[-1], columns=columns
            )
            for record in found:
                self._recorded[record.vehicle, record.day].append(record)

    def recorded(self, partition: Partition) -> tuple[CalibrationRecord, ...]:
        """The day's records, the current one of a kind last; without what an outcome does not say."""
        return tuple(self._recorded.get((partition.vehicle, partition.day), ()))

    def add(self, outcome: Outcome) -> None:
        """Take the records of an outcome; commit those that came together, if it is time.

        Raises:
            OSError: the storage does not answer; the records are kept, and the next commit has them too.
        """
        if outcome.status == "cached":
            self._again += self._not_current(outcome.records)
        else:
            self._new += outcome.records
        waiting = len(self._new) + len(self._again)
        if waiting >= _ROWS or (waiting and time.monotonic() - self._committed_at > _EVERY_S):
            self.commit()

    def commit(self) -> None:
        """Commit what has not been yet.

        Raises:
            OSError: the storage does not answer; the records are kept.
        """
        self._committed_at = time.monotonic()
        if self._new:
            commit_records(self._lake, CALIBRATIONS, self._new)
            self._new = []
        if self._again:
            assert_records(self._lake, CALIBRATIONS, self._again)
            self._again = []

    def _not_current(self, records: Sequence[CalibrationRecord]) -> list[CalibrationRecord]:
        """Of recorded rows those that others about the same came after: they are to be current again."""
        if not records:
            return []
        last = {}
        for row in self._recorded.get((records[0].vehicle, records[0].day), ()):
            last[row.trio, row.method, row.pair] = row.work_key
        return [r for r in records if last.get((r.trio, r.method, r.pair)) != r.work_key]
