"""Read and write partitions (replaced atomically as a whole) and records (append-only, named after their work key)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import ContractError
from pipeline.store.atomic_write import atomic_write
from pipeline.store.partitions import Lake, Partition
from pipeline.store.rows import from_table, to_table
from schemas.columns import TableSchema

__all__ = [
    "Manifest",
    "PartitionWriter",
    "iterate_rows",
    "read_manifest",
    "read_records",
    "read_rows",
    "write_partition",
    "write_records",
]

Row = TypeVar("Row")
_KEY = b"boresight"


@dataclass(frozen=True)
class Manifest:
    """Provenance in the Parquet footer of every file."""

    table: str
    version: int
    work_key: str
    code_version: str
    inputs: list[str] = field(default_factory=list)
    rows: int = 0
    kept: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)


class PartitionWriter:
    """Streams rows of one partition into a temporary file; nothing is visible until the block ends without an error."""

    def __init__(self, writer: pq.ParquetWriter, schema: TableSchema) -> None:
        self._writer, self._schema = writer, schema
        self.rows = 0
        self.manifest_fields: dict[str, Any] = {}

    def append(self, rows: Sequence[Any]) -> None:
        """Write rows as one row group."""
        if rows:
            self._writer.write_table(to_table(rows, self._schema), row_group_size=len(rows))
            self.rows += len(rows)

    def describe(self, *, kept: dict[str, int], rejected: dict[str, int], **extra: Any) -> None:
        """Counts for the manifest."""
        self.manifest_fields = {"kept": kept, "rejected": rejected, "extra": extra}


@contextmanager
def write_partition(
    lake: Lake,
    schema: TableSchema,
    partition: Partition,
    work_key: str,
    code_version: str,
    inputs: Iterable[str] = (),
) -> Iterator[PartitionWriter]:
    """Replace one partition as a whole, atomically; on an error the old file stays."""
    with _replacing(lake.file(schema.name, partition), schema) as parquet:
        writer = PartitionWriter(parquet, schema)
        yield writer
        manifest = Manifest(
            schema.name,
            schema.version,
            work_key,
            code_version,
            list(inputs),
            writer.rows,
            **writer.manifest_fields,
        )
        parquet.add_key_value_metadata({_KEY.decode(): json.dumps(manifest.__dict__)})


def write_records(
    lake: Lake, schema: TableSchema, partition: Partition, rows: Sequence[Any], work_key: str, code_version: str,
    inputs: Iterable[str] = (),
) -> Path:  # fmt: skip
    """Add one record file named after its work key; the same work writes the same file again."""
    path = lake.folder(schema.name, partition) / f"{work_key}.parquet"
    with _replacing(path, schema) as parquet:
        parquet.write_table(to_table(rows, schema))
        manifest = Manifest(schema.name, schema.version, work_key, code_version, list(inputs), len(rows))
        parquet.add_key_value_metadata({_KEY.decode(): json.dumps(manifest.__dict__)})
    return path


def read_manifest(lake: Lake, schema: TableSchema, partition: Partition) -> Manifest | None:
    """Manifest of a partition, None where there is no such partition."""
    path = lake.file(schema.name, partition)
    return _manifest(path, schema) if path.exists() else None


def read_rows(lake: Lake, schema: TableSchema, partition: Partition, row_type: type[Row]) -> list[Row]:
    """All rows of a partition at once; for frames prefer `iterate_rows`."""
    return [row for chunk in iterate_rows(lake, schema, partition, row_type) for row in chunk]


def iterate_rows(
    lake: Lake,
    schema: TableSchema,
    partition: Partition,
    row_type: type[Row],
    rows: Sequence[int] | None = None,
) -> Iterator[list[Row]]:
    """Rows of a partition, one row group at a time, so that memory stays bounded; `rows` picks row numbers.

    Raises:
        ContractError: there is no such partition, or it was written with another schema version.
    """
    path = lake.file(schema.name, partition)
    if not path.exists():
        raise ContractError(
            str(path), f"table {schema.name} has no partition for {partition.vehicle} on {partition.day}"
        )
    _manifest(path, schema)
    wanted = None if rows is None else set(rows)
    with pq.ParquetFile(path) as file:
        first = 0
        for group in range(file.num_row_groups):
            count = file.metadata.row_group(group).num_rows
            picked = (
                list(range(count)) if wanted is None else [i for i in range(count) if first + i in wanted]
            )
            first += count
            if picked:
                table = file.read_row_group(group)
                yield from_table(table if len(picked) == count else table.take(picked), schema, row_type)


def read_records(
    lake: Lake,
    schema: TableSchema,
    row_type: type[Row],
    *,
    vehicle: str | None = None,
    day: str | None = None,
) -> list[Row]:
    """Records of a table in order of vehicle, day and file time; `current_records` keeps the last of a kind."""
    found: list[Row] = []
    for partition in lake.partitions(schema.name, vehicle, day):
        folder = lake.folder(schema.name, partition)
        for path in sorted(folder.glob("*.parquet"), key=lambda p: (p.stat().st_mtime_ns, p.name)):
            _manifest(path, schema)
            with pq.ParquetFile(path) as file:
                found += from_table(file.read(), schema, row_type)
    return found


@contextmanager
def _replacing(path: Path, schema: TableSchema) -> Iterator[pq.ParquetWriter]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_write(path) as stream,
        pq.ParquetWriter(stream, schema.arrow_schema(), **_writer_options(schema)) as parquet,
    ):
        yield parquet


def _writer_options(schema: TableSchema) -> dict[str, Any]:
    arrow = schema.arrow_schema()
    nested = any(pa.types.is_nested(f.type) for f in arrow)
    # JPEG and PNG don't compress further; zstd on them only costs time. Nested columns name their leaves apart.
    # Arrays: LZ4 writes in half zstd's time and reads in a quarter, for a tenth more space (on a real day).
    # Points' coordinates and times are noise in their low bits: compressing them takes twice the time for a twelfth
    # of the space.
    coded = {
        "image",
        "labels_png",
        "road_contrast_png",
        "lidar_x_m",
        "lidar_y_m",
        "lidar_z_m",
        "lidar_time_s",
    }
    compressed = {
        c.name: "NONE" if c.name in coded else "LZ4" if c.is_array else "ZSTD" for c in schema.columns
    }
    if nested:
        for f in arrow:
            if pa.types.is_list(f.type):
                compressed[f"{f.name}.list.element"] = "ZSTD"
            elif pa.types.is_map(f.type):
                compressed |= {f"{f.name}.key_value.key": "ZSTD", f"{f.name}.key_value.value": "ZSTD"}
    flat = [
        f.name
        for f in arrow
        if f.name in {"frame_index", "stamp_ns", "vehicle", "day", "method", "pair", "status"}
    ]
    return {"compression": compressed, "use_dictionary": False, "write_statistics": flat}


def _manifest(path: Path, schema: TableSchema) -> Manifest:
    try:
        raw = (pq.read_metadata(path).metadata or {}).get(_KEY)
    except pa.ArrowInvalid as err:
        raise ContractError(str(path), f"is damaged, make it anew: {err}") from err
    if raw is None:
        raise ContractError(str(path), "was not written by Boresight (no manifest in the footer)")
    values = json.loads(raw)
    found, version = values.get("table"), values.get("version")
    if found != schema.name or version not in (schema.version, *schema.reads_versions):
        problem = f"holds {found}/{version}, this version reads {schema.name}/{schema.version}: make it anew"
        raise ContractError(str(path), problem)
    return Manifest(**{f.name: values[f.name] for f in fields(Manifest) if f.name in values})
