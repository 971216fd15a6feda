"""Migration of a lake of releases before 0.6, which stored records as Parquet files, to record tables."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import ContractError
from pipeline.results import Progress
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from pipeline.store.rows import from_table, with_what_follows
from schemas.columns import TableSchema

__all__ = ["Migrated", "migrate_table"]

_FILES_A_COMMIT = 500  # some thousand rows: then a commit costs little compared with reading the files


@dataclass
class Migrated:
    """Result of the migration of a table's record files."""

    files: int = 0
    rows: int = 0
    damaged: list[str] = field(default_factory=list)


def migrate_table(lake: Lake, schema: TableSchema, row_type: type[Any], progress: Progress) -> Migrated:
    """Move all record files of a table into its record table, and remove them.

    A file is removed after the commit of its rows, and existing rows are not added again, so an interrupted
    migration can continue. The times of the files determined which record was current: they become
    `recorded_at` and `asserted_at`. Unreadable files are moved into `_damaged` and reported.

    Raises:
        ContractError: a file of another table or version.
        OSError: the storage does not answer.
    """
    lake = replace(lake, migrating=True)
    done, folder = Migrated(), lake.local_root / schema.name
    files = sorted(
        folder.glob("vehicle=*/day=*/*.parquet"), key=lambda p: (*p.parts[:-1], p.stat().st_mtime_ns, p.name)
    )
    for at in range(0, len(files), _FILES_A_COMMIT):
        progress(at, len(files), schema.name)
        batch = files[at : at + _FILES_A_COMMIT]
        rows = list(_dated(_read(batch, folder, schema, row_type, done)))
        commit_records(lake, schema, rows)
        done.files += len(batch)
        done.rows += len(rows)
        for path in batch:
            path.unlink(missing_ok=True)
    _remove_empty(folder)
    progress(len(files), len(files), schema.name)
    return done


def _read(
    files: Sequence[Path], folder: Path, schema: TableSchema, row_type: type[Any], done: Migrated
) -> Iterator[tuple[int, list[Any]]]:
    """Time [ns] and rows of each readable file; the others are moved away."""
    for path in files:
        try:
            with pq.ParquetFile(path) as file:
                _check(path, file.metadata.metadata or {}, schema)
                whole = with_what_follows(file.read(), schema, list(schema.follows))
                rows = from_table(whole, schema, row_type)
        except (pa.ArrowException, EOFError) as err:
            aside = folder / "_damaged" / "_".join(path.parts[-3:])
            done.damaged.append(f"{aside}: {str(err).splitlines()[0]}")
            aside.parent.mkdir(exist_ok=True)
            path.replace(aside)
            continue
        yield path.stat().st_mtime_ns, rows


def _check(path: Path, footer: dict[bytes, bytes], schema: TableSchema) -> None:
    manifest = json.loads(footer.get(b"boresight", b"{}"))
    found = (manifest.get("table"), manifest.get("version"))
    if found not in {(schema.name, version) for version in schema.reads_versions}:
        known = " and ".join(f"{schema.name}/{v}" for v in schema.reads_versions)
        raise ContractError(str(path), f"holds {found[0]}/{found[1]}, a migration reads {known}")


def _dated(files: Iterator[tuple[int, list[Any]]]) -> Iterator[Any]:
    """Rows with the time of their file, in whole microseconds, strictly increasing from file to file."""
    last: dict[tuple[str, str], dt.datetime] = {}
    for modified_ns, rows in files:
        stamp = dt.datetime.fromtimestamp(0, dt.UTC) + dt.timedelta(microseconds=modified_ns // 1000)
        for row in rows:
            before = last.get((row.vehicle, row.day))
            if before is not None and stamp <= before:
                stamp = before + dt.timedelta(microseconds=1)
        text = stamp.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        for row in rows:
            last[row.vehicle, row.day] = stamp
            yield replace(row, recorded_at=text, asserted_at=text)


def _remove_empty(folder: Path) -> None:
    """Remove folders of days and vehicles, and files left by killed writers in them."""
    for day in folder.glob("vehicle=*/day=*"):
        for left in day.glob(".writing-*.tmp"):
            left.unlink(missing_ok=True)
        with suppress(OSError):  # not empty: it holds files of other programs
            day.rmdir()
            day.parent.rmdir()
