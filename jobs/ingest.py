"""`boresight ingest` and `boresight perceive`: one stage of one vehicle-day."""

from __future__ import annotations

from pathlib import Path

from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.runner import Stage
from pipeline.core.stage_work import Task
from pipeline.core.stages import INGEST, PERCEIVE
from pipeline.fleet.ledger import record_outcome
from pipeline.rig.day_prior import require_named_files
from pipeline.store.partitions import Lake, Partition, last_possible_day
from pipeline.store.remote_logs import LogPath, log_at

__all__ = ["ingest", "perceive"]


def ingest(*logs: str, fleet: Path, lake: str, vehicle: str, day: str) -> int:
    """Synchronise the sensors of one vehicle-day and store the moments that they share.

    Args:
        logs: MCAP files, ROS 1 bags, ROS 2 bag folders or .db3 files of that day, in any order; or
            s3://BUCKET/KEY.
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
    """
    if not logs:
        raise ConfigError("command line", "LOG", "name at least one log of the day")
    if day > last_possible_day():
        raise ConfigError("command line", "day", f"{day} is in the future")
    return _run(INGEST, fleet, Lake.at(lake), Partition(vehicle, day), tuple(log_at(log) for log in logs))


def perceive(*, fleet: Path, lake: str, vehicle: str, day: str) -> int:
    """Find semantics, objects, ground, edges and motion in every frame of one vehicle-day.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
    """
    return _run(PERCEIVE, fleet, Lake.existing(lake), Partition(vehicle, day))


def _run(stage: Stage, fleet: Path, lake: Lake, of: Partition, logs: tuple[LogPath, ...] = ()) -> int:
    config = load_fleet(fleet)
    require_named_files(config)
    with progress_reporter(f"{stage.name} {of.vehicle} {of.day}") as progress:
        outcome = stage.run(Task(config, lake, of, logs=logs, progress=progress))
    record_outcome(lake, outcome)
    names = ("stage", "vehicle", "day", "work_key", "rows", "kept", "rejected", "reason", "outputs", "faults")
    print_summary(stage.name, outcome.status, **{name: getattr(outcome, name) for name in names})
    return exit_code([outcome.status])
