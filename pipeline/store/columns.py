"""Columns of record tables as NumPy arrays: what thousands of vehicles' records are worked on as."""

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
    """Rows whose columns hold nothing but names that are known, by column."""
    for column, known in names.items():
        table = table.filter(pc.is_in(table[column], pa.array(known)))
    return table


def there(column: pa.ChunkedArray) -> Bool[np.ndarray, " N"]:
    """Where a column is not null."""
    return np.asarray(column.is_valid().combine_chunks()).astype(bool)


def matrices(column: pa.ChunkedArray, shape: tuple[int, ...] = (_DOFS, _DOFS)) -> Float[np.ndarray, "N ..."]:
    """Covariances, or arrays of another shape; not finite where a column has none, or a blob of another size."""
    size = 8 * math.prod(shape)
    whole = there(column) & (pc.binary_length(column).fill_null(0).to_numpy() == size)
    found = np.full((len(whole), *shape), np.nan)
    if whole.any():
        blobs = b"".join(column.filter(pa.array(whole)).to_pylist())
        found[whole] = np.frombuffer(blobs, "<f8").reshape(-1, *shape)
    return found


def observable_dofs(column: pa.ChunkedArray) -> Bool[np.ndarray, "N 6"]:
    """Per DoF; a record that does not say has determined them all."""
    values = column.combine_chunks()
    seen = np.ones((len(values), _DOFS), bool)
    said = there(column) & (pc.list_value_length(values).fill_null(0).to_numpy() == _DOFS)
    if said.any():
        flat = values.filter(pa.array(said)).flatten()
        seen[said] = np.asarray(flat.to_numpy(zero_copy_only=False)).astype(bool).reshape(-1, _DOFS)
    return seen


def ordinals(days: pa.ChunkedArray) -> Int[np.ndarray, " N"]:
    """Days of the calendar, YYYY-MM-DD, as ordinals; 0 where a column has none."""
    coded = pc.fill_null(days, "").combine_chunks().dictionary_encode()
    known = [dt.date.fromisoformat(day).toordinal() if day else 0 for day in coded.dictionary.to_pylist()]
    return np.array(known, np.int64)[np.asarray(coded.indices)]


def places(column: pa.ChunkedArray, names: Sequence[str]) -> Int[np.ndarray, " N"]:
    """Where each value of a column stands among names; -1 where it is none of them."""
    coded = pc.fill_null(column, "").combine_chunks().dictionary_encode()
    known = {name: place for place, name in enumerate(names)}
    place = np.array([known.get(name, -1) for name in coded.dictionary.to_pylist()], np.int64)
    return place[np.asarray(coded.indices)]
