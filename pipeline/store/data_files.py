"""Data files of a record table: those in its log, or all existing files if the log is damaged."""

from __future__ import annotations

import math
from pathlib import PurePosixPath

import pyarrow as pa

from pipeline.core.errors import DamagedLogError
from pipeline.store.delta import LiveFile, live_files, open_table, spans_of_file
from pipeline.store.partitions import Lake
from schemas.columns import TableSchema

__all__ = ["data_files", "files_there", "once"]


def data_files(lake: Lake, schema: TableSchema) -> list[LiveFile]:
    """Data files of a table; if its log is damaged, all existing ones, with a note in `lake.damage`."""
    try:
        table = open_table(lake, schema)
    except DamagedLogError as err:
        lake.damage.append(str(err))
        return [
            LiveFile(name, *spans_of_file(lake, schema, name), math.inf, in_log=False)
            for name in files_there(lake, schema)
        ]
    return live_files(table) if table is not None else []


def files_there(lake: Lake, schema: TableSchema) -> list[str]:
    """Names of all data files of a table, in its log or not."""
    folder = lake.root / schema.name
    found = lake.files.find(folder, "month=*/*.parquet")
    return sorted(str(PurePosixPath(path.relative_to(folder))) for path in found)


def once(rows: pa.Table, schema: TableSchema) -> pa.Table:
    """Rows without duplicates of the same work and key (the last asserted one stays)."""
    names = [*schema.about, "work_key", "asserted_at"]
    if not set(names) <= set(rows.column_names):
        return rows
    last: dict[tuple[str, ...], tuple[str, int]] = {}
    for at, (*key, asserted) in enumerate(zip(*(rows[n].to_pylist() for n in names), strict=True)):
        last[tuple(key)] = max(last.get(tuple(key), ("", -1)), (asserted, at))
    return rows.take(pa.array(sorted(at for _, at in last.values()), pa.int64()))
