"""Reading and writing of partitions, each replaced atomically as a whole; for records see `records.py`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import PurePath
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core.errors import CollectedError, ContractError, DamagedError, OtherVersionError
from pipeline.store.files import opened_parquet
from pipeline.store.partitions import Lake, Partition
from pipeline.store.rows import from_table, to_table
from schemas.columns import TableSchema
from schemas.versions import CODE_VERSION

__all__ = [
    "COLLECTED", "Manifest", "PartitionWriter", "RowGroup", "absence", "iterate_rows", "naming_damage",
    "opened_for_writing", "read_columns", "read_group", "read_manifest", "read_rows", "row_groups",
    "write_manifest", "write_partition",
]  # fmt: skip

Row = TypeVar("Row")
_KEY = b"boresight"
# A row group: large enough to compress, small enough for a worker with one of each sensor to stay far below 2
# GB.
_GROUP_ROWS = 16
_GROUP_BYTES = 24 << 20
COLLECTED = "collected"  # key in a manifest's extra: the day on which the partition's rows were deleted


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
    remarks: str = ""  # text of the outcome although the work was done


class PartitionWriter:
    """Streams rows of one partition; they appear when the block ends without an error."""

    def __init__(self, writer: pq.ParquetWriter, schema: TableSchema) -> None:
        self._writer, self.schema = writer, schema
        self._held: list[Any] = []
        self._held_bytes = self._written = 0
        self.manifest_fields: dict[str, Any] = {}

    @property
    def rows(self) -> int:
        """Number of rows so far."""
        return self._written + len(self._held)

    def add(self, row: Any) -> int:
        """Add a row, which is written in a row group with others; returns its row number in the file."""
        self._held.append(row)
        self._held_bytes += _bytes_of(row)
        place = self.rows - 1
        if self._held_bytes >= _GROUP_BYTES or len(self._held) >= _GROUP_ROWS:
            self._write_held()
        return place

    def _write_held(self) -> None:
        rows, self._held, self._held_bytes = self._held, [], 0
        self.append(rows)

    def append(self, rows: Sequence[Any]) -> None:
        """Write rows as one row group."""
        if rows:
            self._writer.write_table(to_table(rows, self.schema), row_group_size=len(rows))
            self._written += len(rows)

    def describe(
        self, *, kept: dict[str, int], rejected: dict[str, int], remarks: str = "", **extra: Any
    ) -> None:
        """Set counts and texts of the manifest."""
        self.manifest_fields = {"kept": kept, "rejected": rejected, "remarks": remarks, "extra": extra}

    def close(self, work_key: str, inputs: Iterable[str] = ()) -> None:
        """Write the remaining rows, then the manifest."""
        self._write_held()
        of = self.schema.name, self.schema.version, work_key, CODE_VERSION, list(inputs), self.rows
        self.seal(Manifest(*of, **self.manifest_fields))

    def seal(self, manifest: Manifest) -> None:
        """Write the manifest."""
        self._writer.add_key_value_metadata({_KEY.decode(): json.dumps(manifest.__dict__)})


def _bytes_of(row: Any) -> int:
    """Memory of a row's arrays and blobs [bytes]; the rest is small."""
    values = (getattr(row, f.name) for f in fields(row))
    return sum(len(v) if isinstance(v, bytes) else getattr(v, "nbytes", 0) for v in values)


@contextmanager
def opened_for_writing(lake: Lake, path: PurePath, schema: TableSchema) -> Iterator[PartitionWriter]:
    """A file of a partition, which is renamed to its name when the block ends without an error."""
    with (
        lake.files.replacing(path) as stream,
        pq.ParquetWriter(stream, schema.arrow_schema(), **_writer_options(schema)) as parquet,
    ):
        yield PartitionWriter(parquet, schema)


@contextmanager
def write_partition(
    lake: Lake, schema: TableSchema, partition: Partition, work_key: str, inputs: Iterable[str] = ()
) -> Iterator[PartitionWriter]:
    """Replace one partition as a whole, atomically; on an error the old file stays."""
    with opened_for_writing(lake, lake.file(schema.name, partition), schema) as writer:
        yield writer
        writer.close(work_key, inputs)


def write_manifest(lake: Lake, schema: TableSchema, partition: Partition, manifest: Manifest) -> None:
    """Replace a partition by its manifest, without rows."""
    with opened_for_writing(lake, lake.file(schema.name, partition), schema) as writer:
        writer.seal(manifest)


def read_manifest(
    lake: Lake, schema: TableSchema, partition: Partition, sensor: str | None = None
) -> Manifest | None:
    """Manifest of a partition, or of its file of a sensor; None if there is no such file."""
    path = lake.file(schema.name, partition, sensor)
    try:
        with naming_damage(path), opened_parquet(lake.files, path) as file:
            raw = (file.metadata.metadata or {}).get(_KEY)
    except FileNotFoundError:
        return None
    if raw is None:
        raise ContractError(str(path), "was not written by Boresight (no manifest in the footer)")
    values = json.loads(raw)
    found, version = values.get("table"), values.get("version")
    if (found, version) != (schema.name, schema.version):
        release, reads = values.get("code_version", "?"), f"{schema.name}/{schema.version}"
        is_newer = found == schema.name and version > schema.version
        remedy = "use that release" if is_newer else "make it anew"
        raise OtherVersionError(str(path), f"{found}/{version}", release, reads, remedy)
    return Manifest(**{f.name: values[f.name] for f in fields(Manifest) if f.name in values})


def absence(schema: TableSchema, partition: Partition) -> str:
    """Error text for a missing partition, with the remedy."""
    problem = f"table {schema.name} has no partition for {partition.vehicle} on {partition.day}"
    problem += f": run `boresight {schema.made_by}` first" if schema.made_by else ""
    return problem


def read_rows(lake: Lake, schema: TableSchema, partition: Partition, row_type: type[Row]) -> list[Row]:
    """All rows of a partition at once; for frames prefer `iterate_rows`."""
    return [row for chunk in iterate_rows(lake, schema, partition, row_type) for row in chunk]


def iterate_rows(
    lake: Lake, schema: TableSchema, partition: Partition, row_type: type[Row],
    rows: Sequence[int] | None = None, sensor: str | None = None,
) -> Iterator[list[Row]]:  # fmt: skip
    """Rows of a partition, or of a sensor's file, one row group at a time; `rows` selects row numbers.

    Raises:
        ContractError: there is no such partition, or it was written with another schema version.
        DamagedError: its file cannot be read.
        CollectedError: its rows were deleted at the end of their retention.
    """
    path = _with_rows(lake, schema, partition, sensor)
    wanted = None if rows is None else set(rows)
    with opened_parquet(lake.files, path) as file:
        first = 0
        for group in range(file.metadata.num_row_groups):
            count = file.metadata.row_group(group).num_rows
            picked = (
                list(range(count)) if wanted is None else [i for i in range(count) if first + i in wanted]
            )
            first += count
            if picked:
                with naming_damage(path):
                    table = file.groups([group])
                yield from_table(table if len(picked) == count else table.take(picked), schema, row_type)


@dataclass(frozen=True, order=True)
class RowGroup:
    """One row group of one partition."""

    partition: Partition
    index: int
    rows: int


def read_columns(
    lake: Lake, schema: TableSchema, partition: Partition, names: Sequence[str]
) -> dict[str, list[Any]]:
    """Plain columns of a whole partition, without reading the others. Arrays are returned as bytes.

    Raises:
        ContractError: there is no such partition, or it was written with another schema version.
        DamagedError: its file cannot be read.
    """
    path = _with_rows(lake, schema, partition)
    with naming_damage(path), opened_parquet(lake.files, path) as file:
        table = file.groups(list(range(file.metadata.num_row_groups)), list(names))
    return {name: table.column(name).to_pylist() for name in names}


def row_groups(lake: Lake, schema: TableSchema, partition: Partition) -> list[RowGroup]:
    """The row groups of a partition, in order; raises ContractError if missing or of another version."""
    with opened_parquet(lake.files, _with_rows(lake, schema, partition)) as file:
        metadata = file.metadata
    return [RowGroup(partition, i, metadata.row_group(i).num_rows) for i in range(metadata.num_row_groups)]


def read_group(lake: Lake, schema: TableSchema, group: RowGroup, row_type: type[Row]) -> list[Row]:
    """All rows of a group, arrays as views into one buffer; errors as `row_groups`."""
    path = lake.file(schema.name, group.partition)
    try:
        with naming_damage(path), opened_parquet(lake.files, path) as file:
            return from_table(file.groups([group.index]), schema, row_type)
    except FileNotFoundError as err:
        raise ContractError(str(path), "the partition disappeared while it was read") from err


def _with_rows(lake: Lake, schema: TableSchema, partition: Partition, sensor: str | None = None) -> PurePath:
    """File of a partition that has its rows; raises as `iterate_rows`."""
    path = lake.file(schema.name, partition, sensor)
    manifest = read_manifest(lake, schema, partition, sensor)
    if manifest is None:
        raise ContractError(str(path), absence(schema, partition))
    if COLLECTED in manifest.extra:
        raise CollectedError(str(path), manifest.extra[COLLECTED])
    return path


def _writer_options(schema: TableSchema) -> dict[str, Any]:
    arrow = schema.arrow_schema()
    # JPEG and PNG do not compress further; zstd on them only costs time. Nested columns list their leaves
    # separately. Arrays: LZ4 writes in half zstd's time and reads in a quarter, for a tenth more space (on a
    # real day). Low bits of coordinates and times are noise: compressing them takes twice the time for a
    # twelfth of the space.
    coded = {
        "image",
        "labels_png",
        "road_contrast_png",
        "steps_png",
        "lidar_x_m",
        "lidar_y_m",
        "lidar_z_m",
        "lidar_time_s",
    }
    compressed = {
        c.name: "NONE" if c.name in coded else "LZ4" if c.is_array else "ZSTD" for c in schema.columns
    }
    for f in arrow:
        if pa.types.is_list(f.type):
            compressed[f"{f.name}.list.element"] = "ZSTD"
        elif pa.types.is_map(f.type):
            compressed |= {f"{f.name}.key_value.key": "ZSTD", f"{f.name}.key_value.value": "ZSTD"}
    flat = {"frame_index", "stamp_ns", "vehicle", "day", "method", "pair", "status"} & {*arrow.names}
    return {"compression": compressed, "use_dictionary": False, "write_statistics": sorted(flat)}


@contextmanager
def naming_damage(path: PurePath) -> Iterator[None]:
    """Turn reader errors caused by a file's content into a DamagedError that names the file."""
    try:
        yield
    except pa.ArrowException as err:
        raise DamagedError(str(path), str(err).splitlines()[0]) from err
    except OSError as err:
        if err.errno is not None:  # a problem of disk or network, not of the file
            raise
        raise DamagedError(str(path), str(err).splitlines()[0]) from err
