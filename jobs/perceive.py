"""`boresight perceive`: frames of one vehicle-day to observations."""

from __future__ import annotations

from pathlib import Path

__all__ = ["perceive"]


def perceive(*, fleet: Path, lake: str, vehicle: str, day: str) -> int:
    """Find semantics, objects, ground, edges and motion in every frame of one vehicle-day.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
    """
    from dataclasses import asdict

    from jobs.terminal.summary import exit_code, print_summary, progress_reporter
    from pipeline.config import load_fleet
    from pipeline.perceive.stage import perceive_day
    from pipeline.store.partitions import Lake, Partition

    config = load_fleet(fleet)
    with progress_reporter(f"perceive {vehicle} {day}") as progress:
        result = perceive_day(Partition(vehicle, day), config, Lake.at(lake), progress)
    fields = asdict(result)
    print_summary("perceive", fields.pop("status"), **fields)
    return exit_code([result.status])
