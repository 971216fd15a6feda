"""Conversion of rows to Arrow tables and back: arrays become blobs, and are read-only when read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.core.errors import ContractError
from schemas.columns import Column, TableSchema

__all__ = ["from_table", "to_table"]

Row = TypeVar("Row")


def to_table(rows: Sequence[Any], schema: TableSchema) -> pa.Table:
    """Arrow table of row dataclasses; raises ContractError for a wrong shape, or None in a full column."""
    columns = []
    for column in schema.columns:
        values = [_encode(getattr(row, column.name), column, schema.name) for row in rows]
        columns.append(pa.array(values, type=column.arrow_field().type))
    return pa.Table.from_arrays(columns, schema=schema.arrow_schema())


def from_table(table: pa.Table, schema: TableSchema, row_type: type[Row]) -> list[Row]:
    """Row dataclasses of a table; array fields are decoded without a copy.

    A column that was not read takes the field's default.

    Raises:
        ContractError: a column that was not read has no default.
    """
    known = {f.name: f for f in fields(row_type)}  # type: ignore[arg-type]
    absent = [c.name for c in schema.columns if c.name not in table.column_names]
    optional = {name for name, f in known.items() if (f.default, f.default_factory) != (MISSING, MISSING)}
    missing = [name for name in absent if name not in optional]
    if missing:
        raise ContractError(schema.name, f"columns missing: {', '.join(missing)}")
    values = {
        c.name: _decode_column(table.column(c.name), c)
        for c in schema.columns
        if c.name in known and c.name not in absent
    }
    return [row_type(**{name: values[name][i] for name in values}) for i in range(table.num_rows)]


def _encode(value: Any, column: Column, table: str) -> Any:
    if value is None:
        if not column.nullable:
            raise ContractError(table, f"column {column.name} may not be null")
        return None
    if column.dtype is None:
        return list(value.items()) if isinstance(value, dict) else value
    array = np.ascontiguousarray(value, dtype=np.dtype(column.dtype))
    wanted = column.shape
    if array.ndim != len(wanted) or any(
        isinstance(w, int) and w != s for w, s in zip(wanted, array.shape, strict=False)
    ):
        raise ContractError(table, f"column {column.name} has shape {array.shape}, not {wanted}")
    return array.tobytes()  # a copy: pyarrow 26 never frees the buffer of a memoryview


def _decode_column(values: pa.ChunkedArray, column: Column) -> list[Any]:
    if column.dtype is not None:
        shape = tuple(s if isinstance(s, int) else -1 for s in column.shape)
        return [_decode_blob(v, np.dtype(column.dtype), shape) for v in _scalars(values)]
    if column.kind.startswith("map"):
        return [dict(v.as_py()) if v.is_valid else None for v in _scalars(values)]
    return values.to_pylist()


def _decode_blob(value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> np.ndarray | None:
    if not value.is_valid:
        return None
    buffer = value.as_buffer()
    if buffer.size == 0:
        return np.zeros([0 if s == -1 else s for s in shape], dtype)
    return np.frombuffer(buffer, dtype).reshape(shape)


def _scalars(values: pa.ChunkedArray) -> Iterable[Any]:
    for chunk in values.chunks:
        yield from chunk
