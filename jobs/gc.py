"""`boresight gc`: what leaves a lake after its time."""

from __future__ import annotations

__all__ = ["gc"]


def gc(
    *, lake: str, images_days: int = 30, observations_days: int | None = None, dry_run: bool = False
) -> int:
    """Take moments, with their images of public roads, and day pages that show them out of a lake. Records stay.

    Moments of days that a night is given again are made anew where a changed configuration asks for them. A page that
    left is drawn again, without pictures, by the next night whose window holds its day, or by `boresight report`.

    Args:
        lake: folder of the tables.
        images_days: days whose images stay, today among them; the day is the vehicle-day's own.
        observations_days: days whose observations (outlines, clusters, a grey map of the road's contrast) stay;
            default: all, so that a new release can calibrate them again.
        dry_run: only say what would go.
    """
    import datetime as dt

    from jobs.terminal.summary import print_summary
    from pipeline.errors import ConfigError
    from pipeline.store.partitions import Lake
    from pipeline.store.retention import collect, collect_pages, first_day_kept
    from schemas.moments import MOMENTS, PERCEIVED

    for name, days in (("images-days", images_days), ("observations-days", observations_days)):
        if days is not None and days < 1:
            raise ConfigError("command line", name, f"{days} is less than one")
    tables, today = Lake.existing(lake), dt.datetime.now(dt.UTC).date()
    kept = {MOMENTS: images_days} | ({} if observations_days is None else {PERCEIVED: observations_days})
    gone = {
        schema.name: list(
            collect(tables, schema, first_day_kept(today, days), today.isoformat(), dry_run=dry_run)
        )
        for schema, days in kept.items()
    }
    pages = collect_pages(tables, first_day_kept(today, images_days), dry_run=dry_run)
    print_summary(
        "gc",
        "planned" if dry_run else "done" if pages or any(gone.values()) else "cached",
        partitions={name: len(found) for name, found in gone.items()},
        freed_bytes=sum(c.freed_bytes for found in gone.values() for c in found),
        pages=len(pages),
        damaged=sorted(set(tables.damage)),
    )
    return 0
