"""Tables as dataclasses: arrays have one entry per row, other fields apply to all rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

__all__ = ["columns_of", "join_rows", "take_rows"]

_Table = TypeVar("_Table")


def take_rows(table: _Table, rows: np.ndarray) -> _Table:
    """Subset of rows, by number or mask."""
    return _changed(table, {name: values[rows] for name, values in _arrays(table).items()})


def join_rows(parts: Sequence[_Table]) -> _Table:
    """Rows of all parts, concatenated; fields that are not arrays come from the first part."""
    columns = [_arrays(part) for part in parts]
    return _changed(parts[0], {name: np.concatenate([c[name] for c in columns]) for name in columns[0]})


def columns_of(rows: Sequence[tuple[Any, ...]], dtype: np.dtype) -> dict[str, np.ndarray]:
    """Fields of a structured dtype as arrays with one entry per row; empty arrays for no row."""
    table = np.array(rows, dtype)
    return {name: np.ascontiguousarray(table[name]) for name in dtype.names or ()}


def _arrays(table: Any) -> dict[str, np.ndarray]:
    values = {f.name: getattr(table, f.name) for f in fields(table)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def _changed(table: Any, arrays: dict[str, np.ndarray]) -> Any:
    return replace(table, **arrays)
