"""Repair of a record table with a damaged log or missing files; deletion of moments, images included, after a time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import pyarrow as pa

from pipeline.core.errors import ContractError, DamagedLogError
from pipeline.store.delta import (
    DAMAGED,
    LOG,
    create_table,
    live_files,
    merge_rows,
    open_table,
    read_file,
    set_aside,
    set_aside_damaged,
    with_months,
)
from pipeline.store.moments import sensor_files, sensor_tables
from pipeline.store.partitions import Lake, Partition, is_day
from pipeline.store.records import files_there, once
from pipeline.store.tables import COLLECTED, read_manifest, write_manifest
from schemas.columns import TableSchema

__all__ = ["Collected", "Repaired", "collect", "collect_pages", "repair_table"]


@dataclass
class Repaired:
    """Problems of a table in words, number of files whose rows were recovered, and lost rows."""

    found: str = ""
    files: int = 0
    lost: list[str] = field(default_factory=list)


def repair_table(lake: Lake, schema: TableSchema) -> Repaired:
    """Add the rows of all data files that the table's log does not list; recorded rows are never duplicated.

    An unreadable log is moved to `_damaged`, and a new one is begun. Unreadable data files, and files whose
    rows were added, are moved there too. If a compacted file is missing, the files that it replaced still
    exist for a week. A killed repair can be run again.

    Raises:
        ContractError: the lake is of another release.
        OSError: the storage does not answer.
    """
    done, said = Repaired(), _said_by_entries(lake, schema)
    try:
        table = open_table(lake, schema)
    except DamagedLogError as err:
        done.found = err.problem
        _set_log_aside(lake, schema)
        create_table(lake, schema)
        live, known = [], set[str]()
    else:
        live = live_files(table) if table is not None else []
        known = set(said)
    words = {n: w for n, w in said.items() if w} | {f.name: _words(f.name, f.vehicles, f.days) for f in live}
    there = files_there(lake, schema)
    bad = {name for name in words if name not in there} if done.found else set[str]()
    bad |= set(set_aside_damaged(lake, schema)) if live else set()
    # Files replaced by a lost file are marked as removed, and may still exist.
    beside = {f.name for f in live} | (set() if bad else known)
    for name in [n for n in there if n not in beside]:
        _take_in(lake, schema, name, done, bad)
    if done.files or bad:
        done.found = done.found or f"{done.files} files are not in its log, {len(bad)} cannot be read"
    done.lost = [words.get(name) or f"{name}: content unknown" for name in sorted(bad)]
    return done


def _take_in(lake: Lake, schema: TableSchema, name: str, done: Repaired, bad: set[str]) -> None:
    """Merge the rows of a file into the table and move the file away."""
    rows = _whole_rows(lake, schema, name)
    if rows is None:
        bad.add(name)
    elif rows.num_rows:
        merge_rows(lake, schema, rows)
        done.files += 1
    set_aside(lake, schema, name)


def _words(name: str, vehicles: tuple[str, str] | None, days: tuple[str, str] | None) -> str:
    spans = {"vehicles": vehicles, "days": days}
    known = [f"{what} {of[0]} to {of[1]}" for what, of in spans.items() if of is not None]
    return f"{name}: rows of {', '.join(known) or 'unknown vehicles and days'}"


def _said_by_entries(lake: Lake, schema: TableSchema) -> dict[str, str]:
    """Descriptions of files by name, from the readable log entries; without removed files."""
    said: dict[str, str] = {}
    folder = lake.root / schema.name / LOG
    for name in sorted(n for n, _ in lake.files.sizes(folder) if n.endswith(".json")):
        with lake.files.opened(folder / name) as stream:
            lines = stream.read().splitlines()
        for line in lines:
            try:
                action = json.loads(line)
                if "remove" in action:
                    said[action["remove"]["path"]] = ""
                elif "add" in action:
                    file = action["add"]["path"]
                    said[file] = _words(file, *_spans(json.loads(action["add"].get("stats") or "{}")))
            except (ValueError, TypeError, KeyError, AttributeError):
                continue  # the damaged entry
    return said


def _spans(stats: dict[str, Any]) -> list[tuple[str, str] | None]:
    """First and last vehicle, first and last day."""
    least, most = stats.get("minValues", {}), stats.get("maxValues", {})
    return [(least[c], most[c]) if c in least and c in most else None for c in ("vehicle", "day")]


def _set_log_aside(lake: Lake, schema: TableSchema) -> None:
    folder = lake.root / schema.name
    before = {path.parent.name for path in lake.files.find(folder / DAMAGED, f"{LOG}*/*")}
    for name, _ in list(lake.files.sizes(folder / LOG)):
        lake.files.move(folder / LOG / name, folder / DAMAGED / f"{LOG}-{len(before) + 1}" / name)


def _whole_rows(lake: Lake, schema: TableSchema, name: str) -> pa.Table | None:
    """All rows of a file; None if it cannot be read, or is of another schema version."""
    rows = read_file(lake, schema, name, [c.name for c in schema.columns])
    if rows is None or rows.num_columns < len(schema.columns):
        return None
    return with_months(once(rows, schema), schema)


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
