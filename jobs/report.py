"""`boresight report`: HTML pages of one vehicle-day, or of the whole fleet."""

from __future__ import annotations

from pathlib import Path

__all__ = ["report"]


def report(
    *,
    fleet: Path,
    lake: str,
    out: Path,
    vehicle: str | None = None,
    day: str | None = None,
    method: str | None = None,
    truth: Path | None = None,
) -> int:
    """Write self-contained HTML: one day with --vehicle and --day, else the fleet with all its days.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        out: the HTML file to write; pages of days go into a folder beside it.
        vehicle: vehicle id.
        day: YYYY-MM-DD.
        method: method of the records; default: audit.method.
        truth: JSON with the true extrinsics of a simulated fleet, shown beside the estimates.
    """
    from jobs.terminal.summary import print_summary
    from pipeline.config import load_fleet
    from pipeline.errors import ConfigError
    from pipeline.report.stage import Pages
    from pipeline.report.truth import read_truth
    from pipeline.stages import REPORT
    from pipeline.store.partitions import Lake, Partition
    from pipeline.work import Task, Window

    if (vehicle is None) != (day is None):
        raise ConfigError("command line", "vehicle, day", "a day's page needs both --vehicle and --day")
    of = Partition(vehicle, day) if vehicle is not None and day is not None else Window()
    pages = Pages(out, read_truth(truth) if truth is not None else None)
    outcome = REPORT.run(Task(load_fleet(fleet), Lake.at(lake), of, method, given=pages))
    print_summary("report", outcome.status, report=out, outputs=outcome.outputs)
    return 0
