"""`boresight perceive`: features of the frames of one vehicle-day."""

from __future__ import annotations

from pathlib import Path

from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.core.config import load_fleet
from pipeline.core.stage_work import Task
from pipeline.core.stages import PERCEIVE
from pipeline.fleet.ledger import record_outcome
from pipeline.rig.day_prior import require_named_files
from pipeline.store.partitions import Lake, Partition

__all__ = ["perceive"]


def perceive(*, fleet: Path, lake: str, vehicle: str, day: str) -> int:
    """Find semantics, objects, ground, edges and motion in every frame of one vehicle-day.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
    """
    config = load_fleet(fleet)
    require_named_files(config)
    tables = Lake.existing(lake)
    with progress_reporter(f"perceive {vehicle} {day}") as progress:
        outcome = PERCEIVE.run(Task(config, tables, Partition(vehicle, day), progress=progress))
    record_outcome(tables, outcome)
    print_summary("perceive", outcome.status, **outcome.counts())
    return exit_code([outcome.status])
