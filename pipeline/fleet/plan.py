"""Plan of a night (`--dry-run`): the stages that would run, and why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pipeline.core.errors import BoresightError
from pipeline.core.runner import why_to_run
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE, INGEST, PERCEIVE
from pipeline.fleet.ledger import Ledger
from pipeline.fleet.nightly import Night, refused_at_once, task_of
from pipeline.fleet.pattern import VehicleDay

__all__ = ["DayPlan", "plan_night"]

_ORDER = (INGEST, PERCEIVE, CALIBRATE)


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
        task = task_of(night, day, ledger.known(day.partition))
        try:
            yield DayPlan(vehicle, date, *_would_run(task))
        except (BoresightError, OSError) as err:
            yield DayPlan(vehicle, date, (), f"would fail: {err}")


def _would_run(task: Task) -> tuple[tuple[str, ...], str]:
    for at, stage in enumerate(_ORDER):
        before = next((r for r in reversed(task.before) if r.stage == stage.name), None)
        why = why_to_run(stage, task)
        if why:
            failed = f", failed before: {before.reason}" if before and before.status == "failed" else ""
            return tuple(s.name for s in _ORDER[at:]), why + failed
        if before is not None and before.status == "refused" and stage is not CALIBRATE:
            return (), f"refused by {stage.name}: {before.reason}"
    return (), "up to date"
