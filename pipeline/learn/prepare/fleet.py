"""One vehicle-day of `boresight prepare` as workers take it."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.config import FleetConfig
from pipeline.errors import BoresightError
from pipeline.learn.prepare.split import SplitPlan
from pipeline.learn.prepare.stage import prepare_day
from pipeline.results import Progress, StageResult
from pipeline.store.partitions import Lake, Partition

__all__ = ["PrepareWork", "run_prepare"]


@dataclass(frozen=True)
class PrepareWork:
    """A vehicle-day and all that a worker needs for it; `plan` holds this day's keys only."""

    partition: Partition
    fleet: FleetConfig
    lake: Lake
    plan: SplitPlan


def run_prepare(work: PrepareWork, progress: Progress) -> StageResult:
    """`prepare_day` whose errors are results: one day's trouble never stops the others."""
    try:
        return prepare_day(work.partition, work.fleet, work.lake, work.plan, progress)
    except (BoresightError, OSError) as err:
        vehicle, day = work.partition.vehicle, work.partition.day
        return StageResult("prepare", vehicle, day, "failed", "", reason=str(err))
