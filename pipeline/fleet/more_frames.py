"""Repeated reading of a long day with more sweeps, if the sweeps read did not suffice for a decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.core.results import Effort, Outcome
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE, INGEST
from schemas.calibrations import ASKS_FOR_FRAMES
from schemas.moments import SWEEPS_LOGGED, SWEEPS_PLANNED

__all__ = ["MOST_TIMES_MORE", "asks_for_more", "spent_before", "with_more_sweeps"]

# Number of doublings: 1,600 sweeps at most, and all passes together cost seven times the first. Sigmas fall
# with the root of the number of frames in a calibration; if four times the choice does not help, more will
# not.
MOST_TIMES_MORE = 2


def asks_for_more(results: Sequence[Outcome]) -> bool:
    """Whether there are unread sweeps and a pair, or the whole day, lacks nothing but frames."""
    read = next((r for r in results if r.stage == INGEST.name), None)
    if read is None or read.kept.get(SWEEPS_LOGGED, 0) <= read.kept.get(SWEEPS_PLANNED, 0):
        return False
    if any(r.status == "failed" for r in results):
        return False
    if any(r.status == "refused" for r in results if r.stage != CALIBRATE.name):
        return True
    return any(_lacks_frames(r.reason) for r in results[-1].records if r.status != "accepted")


def with_more_sweeps(task: Task) -> Task:
    """The task with the next larger `ingest.read_sweeps`."""
    return replace(task, fleet=task.fleet.model_copy(update={"ingest": task.fleet.ingest.wider}))


def spent_before(earlier: Sequence[Outcome], later: Sequence[Outcome]) -> tuple[Outcome, ...]:
    """The later results, with the effort of an earlier pass added to the same stages."""
    efforts = {r.stage: r.effort for r in earlier}
    return tuple(replace(r, effort=_sum(efforts.get(r.stage), r.effort)) for r in later)


def _lacks_frames(reason: str) -> bool:
    """Whether more frames may remove every clause of a record's reason."""
    clauses = reason.split("; ")
    return all(any(words in clause for words in ASKS_FOR_FRAMES) for clause in clauses)


def _sum(a: Effort | None, b: Effort) -> Effort:
    if a is None:
        return b
    read, written = (
        None if x is None or y is None else x + y
        for x, y in ((a.bytes_read, b.bytes_read), (a.bytes_written, b.bytes_written))
    )
    return Effort(a.began_at, a.seconds + b.seconds, read, written)
