"""`boresight repair`: restore record tables whose log or files are damaged."""

from __future__ import annotations

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.store.partitions import Lake
from pipeline.store.repair import repair_table
from schemas.versions import TABLES

__all__ = ["repair"]


def repair(*, lake: str) -> int:
    """Restore damaged record tables from their remaining data files, and list what is lost.

    A damaged log moves to LAKE/<table>/_damaged, and a new one starts; no record is duplicated. Run it while
    no other process writes to the lake. The next night with the logs of a day makes its lost calibrations
    again. Exit code 3 if rows are lost.

    Args:
        lake: folder of the tables.
    """
    tables, done = Lake.existing(lake), {}
    records = [s for s in TABLES.values() if s.is_record_table]
    with progress_reporter("repair") as progress:
        for count, schema in enumerate(records):
            progress(count, len(records), schema.name)
            done[schema.name] = repair_table(tables, schema)
    lost = {name: d.lost for name, d in done.items() if d.lost}
    print_summary(
        "repair",
        "done" if any(d.found for d in done.values()) else "cached",
        found={name: d.found for name, d in done.items() if d.found},
        files={name: d.files for name, d in done.items() if d.files},
        lost=lost,
    )
    return 3 if lost else 0
