"""Columns of record tables as NumPy arrays, for computations on the records of thousands of vehicles."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

__all__ = ["known_rows", "matrices", "observable_dofs", "ordinals", "places", "there"]

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
