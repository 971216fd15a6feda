"""Rows to Arrow tables and back: arrays become blobs, read-only when read; columns of records as NumPy arrays."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

from pipeline.core.errors import ContractError
from schemas.columns import Column, TableSchema

__all__ = [
    "from_table",
    "known_rows",
    "matrices",
    "observable_dofs",
    "ordinals",
    "places",
    "there",
    "to_table",
]

_DOFS = 6


def known_rows(table: pa.Table, names: Mapping[str, Sequence[str]]) -> pa.Table:
    """Rows in which the given columns have only known names."""
    for column, known in names.items():
        table = table.filter(pc.is_in(table[column], pa.array(known)))
    return table


def there(column: pa.ChunkedArray) -> Bool[np.ndarray, " N"]:
    """Mask of the rows where a column is not null."""
    return np.asarray(column.is_valid().combine_chunks()).astype(bool)


def matrices(column: pa.ChunkedArray, shape: tuple[int, ...] = (_DOFS, _DOFS)) -> Float[np.ndarray, "N ..."]:
    """Covariances, or arrays of another shape; NaN if a column has none, or a blob of another size."""
    size = 8 * math.prod(shape)
    whole = there(column) & (pc.binary_length(column).fill_null(0).to_numpy() == size)
    found = np.full((len(whole), *shape), np.nan)
    if whole.any():
        blobs = b"".join(column.filter(pa.array(whole)).to_pylist())
        found[whole] = np.frombuffer(blobs, "<f8").reshape(-1, *shape)
    return found


def observable_dofs(column: pa.ChunkedArray) -> Bool[np.ndarray, "N 6"]:
    """Mask of observable DoF; True for a record without this information."""
    values = column.combine_chunks()
    seen = np.ones((len(values), _DOFS), bool)
    said = there(column) & (pc.list_value_length(values).fill_null(0).to_numpy() == _DOFS)
    if said.any():
        flat = values.filter(pa.array(said)).flatten()
        seen[said] = np.asarray(flat.to_numpy(zero_copy_only=False)).astype(bool).reshape(-1, _DOFS)
    return seen


def ordinals(days: pa.ChunkedArray) -> Int[np.ndarray, " N"]:
    """Calendar days YYYY-MM-DD as ordinals; 0 where a column is null."""
    coded = pc.fill_null(days, "").combine_chunks().dictionary_encode()
    known = [dt.date.fromisoformat(day).toordinal() if day else 0 for day in coded.dictionary.to_pylist()]
    return np.array(known, np.int64)[np.asarray(coded.indices)]


def places(column: pa.ChunkedArray, names: Sequence[str]) -> Int[np.ndarray, " N"]:
    """Index of each value of a column in `names`; -1 if it is not among them."""
    found = pc.index_in(column, pa.array(names, pa.string()))
    return np.asarray(pc.fill_null(found, -1)).astype(np.int64)


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
