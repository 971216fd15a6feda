"""Moments of a vehicle-day: a table that joins rows of the sensors' files, all replaced together.

The joining table (`moments`, `perceived`) has the manifest. It is removed before the first sensor file is
replaced, and written last: if it exists, all files are of the same work.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import PurePath
from typing import Any

from pipeline.core.errors import ContractError
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import (
    COLLECTED,
    Manifest,
    PartitionWriter,
    iterate_rows,
    opened_for_writing,
    read_manifest,
    read_rows,
)
from schemas.captures import CAPTURES
from schemas.columns import TableSchema
from schemas.features import FEATURES
from schemas.moments import FILES

__all__ = [
    "MomentWriter",
    "is_whole",
    "joined",
    "sensor_files",
    "sensor_tables",
    "sensors_of",
    "write_moments",
]

_OF_SENSORS = {t.name: t for t in (*CAPTURES.values(), *FEATURES.values())}
_KINDS = {t.name: kind for tables in (CAPTURES, FEATURES) for kind, t in tables.items()}


class MomentWriter:
    """Streams moments and the rows of their sensors; they appear when the block ends without error."""

    def __init__(self, stack: ExitStack, lake: Lake, partition: Partition, index: PartitionWriter) -> None:
        self._stack, self._lake, self._partition, self._index = stack, lake, partition, index
        self.moments: list[Any] = []  # about a kilobyte each
        self.files: dict[str, PartitionWriter] = {}

    @property
    def rows(self) -> int:
        """Number of moments so far."""
        return len(self.moments)

    def append(self, moment: Any, captures: Mapping[str, Any]) -> None:
        """Add a moment and its rows by sensor name."""
        rows = {sensor: self._file(sensor, row).add(row) for sensor, row in captures.items()}
        self.moments.append(replace(moment, rows=rows))

    def describe(self, **told: Any) -> None:
        """Counts and words for the manifest; see `PartitionWriter.describe`."""
        files = {sensor: file.schema.name for sensor, file in self.files.items()}
        self._index.describe(**told | {FILES: files})

    def _file(self, sensor: str, row: Any) -> PartitionWriter:
        if sensor not in self.files:
            [schema] = [t for t in _OF_SENSORS.values() if t.row_type is type(row)]
            path = self._lake.file(schema.name, self._partition, sensor)
            self.files[sensor] = self._stack.enter_context(opened_for_writing(self._lake, path, schema))
        return self.files[sensor]


@contextmanager
def write_moments(
    lake: Lake, schema: TableSchema, partition: Partition, work_key: str, inputs: Iterable[str] = ()
) -> Iterator[MomentWriter]:
    """Replace the moments of a vehicle-day and the files of its sensors; on an error the old ones stay.

    A writer killed during the final renames leaves a day without moments, which the next one makes again.
    """
    path = lake.file(schema.name, partition)
    with ExitStack() as stack:
        # Left last: the joining table is renamed after all other files.
        index = stack.enter_context(opened_for_writing(lake, path, schema))
        writer = MomentWriter(stack, lake, partition, index)
        yield writer
        index.append(writer.moments)
        for file in writer.files.values():
            file.close(work_key)
        index.close(work_key, inputs)
        lake.files.delete(path)
    kept = {lake.file(f.schema.name, partition, sensor) for sensor, f in writer.files.items()}
    for gone in set(sensor_files(lake, schema, partition)) - kept:  # of sensors that the day no longer has
        lake.files.delete(gone)


def is_whole(lake: Lake, partition: Partition, manifest: Manifest) -> bool:
    """Whether all files named in a joining table's manifest exist, and are of the same work."""
    if COLLECTED in manifest.extra:
        return True
    for sensor, table in manifest.extra.get(FILES, {}).items():
        found = read_manifest(lake, _OF_SENSORS[table], partition, sensor)
        if found is None or found.work_key != manifest.work_key:
            return False
    return True


def sensors_of(manifest: Manifest) -> dict[str, str]:
    """Kind of each sensor with rows, by name, in order of first appearance."""
    return {sensor: _KINDS[table] for sensor, table in manifest.extra.get(FILES, {}).items()}


def sensor_tables(schema: TableSchema) -> list[TableSchema]:
    """Tables of sensors' files that a table joins; empty for other tables."""
    return [table for table in _OF_SENSORS.values() if table.made_by == schema.made_by]


def sensor_files(lake: Lake, schema: TableSchema, partition: Partition) -> list[PurePath]:
    """Files of all sensors of a partition."""
    folders = [lake.folder(table.name, partition) for table in sensor_tables(schema)]
    return [path for folder in folders for path in lake.files.find(folder, "*.parquet")]


def joined(
    lake: Lake,
    schema: TableSchema,
    partition: Partition,
    sensors: Sequence[str] | None = None,
    moments: Sequence[int] | None = None,
    known: dict[str, list[Any]] | None = None,
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Moments of a vehicle-day in order, with rows by sensor; one row group of each file is in memory.

    `known` collects the rows of sensors, of whole days alone: a sensor that it has is not read again.

    Raises:
        ContractError: the lake has none of that day, or they are of another release.
        DamagedError: a file cannot be read.
        CollectedError: the rows were deleted at the end of their retention.
    """
    rows: list[Any] = read_rows(lake, schema, partition, schema.row_type)
    wanted = {m.moment for m in rows} if moments is None else {*moments}
    index = [m for m in rows if m.moment in wanted]
    manifest = read_manifest(lake, schema, partition)
    assert manifest is not None, "its rows were just read"
    files = manifest.extra.get(FILES, {})
    names = list(files) if sensors is None else [s for s in sensors if s in files]
    streams = {
        s: _rows_of(
            lake, _OF_SENSORS[files[s]], partition, s, manifest, [m.rows[s] for m in index if s in m.rows]
        )
        for s in names
    }
    if known is not None:
        known |= {s: list(stream) for s, stream in streams.items() if s not in known}
        streams = {s: iter(known[s]) for s in names}
    for moment in index:
        yield moment, {s: next(stream) for s, stream in streams.items() if s in moment.rows}


def _rows_of(
    lake: Lake, schema: TableSchema, partition: Partition, sensor: str, index: Manifest, rows: Sequence[int]
) -> Iterator[Any]:
    """Rows of a sensor's file, in order; raises ContractError if it is of other work than the index."""
    if not rows:
        return
    found = read_manifest(lake, schema, partition, sensor)
    if found is None or found.work_key != index.work_key:
        problem = f"does not match table {index.table}: run `boresight {schema.made_by}` again"
        raise ContractError(str(lake.file(schema.name, partition, sensor)), problem)
    chunks: Iterator[list[Any]] = iterate_rows(lake, schema, partition, schema.row_type, rows, sensor)
    for chunk in chunks:
        yield from chunk
