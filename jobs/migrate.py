"""`boresight migrate`: convert a lake of an older release to the tables of this one."""

from __future__ import annotations

__all__ = ["migrate"]


def migrate(*, lake: str) -> int:
    """Move the records of a lake written before release 0.6 (Parquet files) into record tables.

    The command can be run again, and continues after a stop. Frames and observations are not changed.

    Args:
        lake: folder of the tables.
    """
    from jobs.terminal.summary import print_summary, progress_reporter
    from pipeline.store.migration import migrate_table
    from pipeline.store.partitions import Lake
    from schemas.calibrations import CALIBRATIONS, CalibrationRecord
    from schemas.drift import DRIFT, DriftFinding

    tables = Lake.existing(lake)
    done = {}
    with progress_reporter("migrate") as progress:
        for schema, row_type in ((CALIBRATIONS, CalibrationRecord), (DRIFT, DriftFinding)):
            done[schema.name] = migrate_table(tables, schema, row_type, progress)
    files = sum(d.files for d in done.values())
    print_summary(
        "migrate",
        "done" if files else "cached",
        files=files,
        rows={name: d.rows for name, d in done.items()},
        damaged=[name for d in done.values() for name in d.damaged],
    )
    return 0
