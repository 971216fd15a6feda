"""`boresight repair` and `boresight gc`: restore damaged record tables, delete old images and observations."""

from __future__ import annotations

import datetime as dt

from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Lake, days_after
from pipeline.store.repair import collect, collect_pages, repair_table
from schemas.moments import MOMENTS, PERCEIVED
from schemas.versions import TABLES

__all__ = ["gc", "repair"]


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


def gc(
    *, lake: str, images_days: int = 30, observations_days: int | None = None, dry_run: bool = False
) -> int:
    """Delete old moments with their images of public roads, and day pages that show them. Records stay.

    If a night gets the logs of a deleted day again, and a changed configuration needs its moments, it makes
    them again. A deleted page is drawn again, without pictures, by the next night with that day in its window
    or by `boresight report`.

    Args:
        lake: folder of the tables.
        images_days: keep images of this many days, today included; the day is the day of the vehicle-day.
        observations_days: keep observations (outlines, clusters, a grey map of the road's contrast) of this
            many days; default: all, so that a new release can calibrate them again.
        dry_run: only list what would be deleted.
    """
    for name, days in (("images-days", images_days), ("observations-days", observations_days)):
        if days is not None and days < 1:
            raise ConfigError("command line", name, f"{days} is less than one")
    tables, today = Lake.existing(lake), dt.datetime.now(dt.UTC).date().isoformat()
    kept = {MOMENTS: images_days} | ({} if observations_days is None else {PERCEIVED: observations_days})
    with progress_reporter("gc") as progress:
        gone = {}
        for schema, days in kept.items():
            progress(0, 0, schema.name)
            found = collect(tables, schema, days_after(today, 1 - days), today, dry_run=dry_run)
            gone[schema.name] = list(found)
        progress(0, 0, "pages")
        pages = collect_pages(tables, days_after(today, 1 - images_days), dry_run=dry_run)
    print_summary(
        "gc",
        "planned" if dry_run else "done" if pages or any(gone.values()) else "cached",
        partitions={name: len(found) for name, found in gone.items()},
        freed_bytes=sum(c.freed_bytes for found in gone.values() for c in found),
        pages=len(pages),
        damaged=sorted(set(tables.damage)),
    )
    return 0
