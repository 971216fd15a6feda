"""`boresight ingest`: logs of one vehicle-day to synchronised frames."""

from __future__ import annotations

from pathlib import Path

from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task
from pipeline.core.stages import INGEST
from pipeline.fleet.ledger import record_outcome
from pipeline.rig.day_prior import require_named_files
from pipeline.store.partitions import Lake, Partition, last_possible_day
from pipeline.store.remote_logs import log_at

__all__ = ["ingest"]


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
        raise ConfigError("command line", "day", f"{day} has not come yet")
    config = load_fleet(fleet)
    require_named_files(config)
    tables = Lake.at(lake)
    with progress_reporter(f"ingest {vehicle} {day}") as progress:
        paths = tuple(log_at(log) for log in logs)
        task = Task(config, tables, Partition(vehicle, day), logs=paths, progress=progress)
        outcome = INGEST.run(task)
    record_outcome(tables, outcome)
    print_summary("ingest", outcome.status, **outcome.counts())
    return exit_code([outcome.status])
