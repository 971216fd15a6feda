"""Single columns and single row groups of partitions: for plans over many days, and for shuffled reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, TypeVar

from pipeline.core.errors import CollectedError, ContractError
from pipeline.store.parquet_file import opened_parquet
from pipeline.store.partitions import Lake, Partition
from pipeline.store.rows import from_table
from pipeline.store.tables import COLLECTED, naming_damage, read_manifest
from schemas.columns import TableSchema

__all__ = ["RowGroup", "read_columns", "read_group", "row_groups"]

Row = TypeVar("Row")


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
    path = _checked(lake, schema, partition)
    with naming_damage(path), opened_parquet(lake.files, path) as file:
        table = file.groups(list(range(file.metadata.num_row_groups)), list(names))
    return {name: table.column(name).to_pylist() for name in names}


def row_groups(lake: Lake, schema: TableSchema, partition: Partition) -> list[RowGroup]:
    """The row groups of a partition, in order; raises ContractError if missing or of another version."""
    with opened_parquet(lake.files, _checked(lake, schema, partition)) as file:
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


def _checked(lake: Lake, schema: TableSchema, partition: Partition) -> PurePath:
    path = lake.file(schema.name, partition)
    manifest = read_manifest(lake, schema, partition)
    if manifest is None:
        raise ContractError(str(path), f"table {schema.name} has no such partition")
    if COLLECTED in manifest.extra:
        raise CollectedError(str(path), manifest.extra[COLLECTED])
    return path
