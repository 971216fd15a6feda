"""Retention: deletion of moments, with their images of public roads, after a time. Records stay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from pipeline.core.errors import ContractError
from pipeline.store.moments import sensor_files, sensor_tables
from pipeline.store.partitions import Lake, Partition, is_day
from pipeline.store.tables import COLLECTED, read_manifest, write_manifest
from schemas.columns import TableSchema

__all__ = ["Collected", "collect", "collect_pages"]


@dataclass(frozen=True)
class Collected:
    """A partition whose rows were deleted, and the number of bytes freed."""

    partition: Partition
    freed_bytes: int


def collect(
    lake: Lake, schema: TableSchema, before: str, today: str, *, dry_run: bool = False
) -> Iterator[Collected]:
    """Delete the rows of partitions of days before `before` (YYYY-MM-DD); `dry_run` only lists them.

    The manifest stays, so that the same logs are not treated as new: reading the rows raises an error with
    the day of deletion, and a night with the logs makes the rows again. Damaged files are deleted completely.
    """
    days = [p for p in lake.partitions(schema.name) if p.day < before]
    yield from (c for p in days if (c := _collect_day(lake, schema, p, today, dry_run=dry_run)) is not None)
    for table in (schema, *sensor_tables(schema)):
        for aside in lake.files.find(lake.root / table.name, "vehicle=*/day=*/*.damaged"):
            if aside.parent.name.removeprefix("day=") < before and not dry_run:
                lake.files.delete(aside)


def _collect_day(
    lake: Lake, schema: TableSchema, partition: Partition, today: str, *, dry_run: bool
) -> Collected | None:
    """Delete the rows of one partition; None if they are deleted already."""
    path, gone = lake.file(schema.name, partition), sensor_files(lake, schema, partition)
    size = sum(lake.files.size(file) for file in (path, *gone))
    try:
        manifest = read_manifest(lake, schema, partition)
    except ContractError as err:
        # Of another release, or damaged: it has no manifest that must stay.
        lake.damage.append(str(err))
        gone.append(path)
    else:
        if manifest is None or COLLECTED in manifest.extra:
            return None
        if not dry_run:
            told = replace(manifest, extra=manifest.extra | {COLLECTED: today})
            write_manifest(lake, schema, partition, told)
    for file in gone if not dry_run else ():
        lake.files.delete(file)
    return Collected(partition, size)


def collect_pages(lake: Lake, before: str, *, dry_run: bool = False) -> list[str]:
    """Remove pages of vehicle-days before `before` from the lake's reports; returns their names."""
    gone = []
    report = lake.root / "report"
    for page in list(lake.files.find(report, "*_days/*/*.html")):
        if is_day(page.parent.name) and page.parent.name < before:
            gone.append(str(page.relative_to(report)))
            if not dry_run:
                lake.files.delete(page)
    return gone
