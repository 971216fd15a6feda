"""Reading of records; of several rows with the same key one is current.

Months, files and columns that are not requested are not read, and damaged files are left out.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import MISSING, fields, replace
from functools import reduce
from itertools import groupby
from operator import itemgetter
from pathlib import PurePosixPath
from typing import Any, Generic, NamedTuple, TypeVar

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.errors import DamagedLogError
from pipeline.store.delta import LiveFile, Wanted, live_files, open_table, read_file, spans_of_file
from pipeline.store.partitions import Lake, LostRows
from pipeline.store.rows import from_table
from schemas.columns import TableSchema

__all__ = [
    "Assertion", "RecordIndex", "files_there", "first_day", "last_assertion", "last_day", "once",
    "read_columns", "read_last", "read_last_columns", "read_latest", "read_records",
]  # fmt: skip

Row = TypeVar("Row")
# Clock difference of machines that write a table: a file is at most this much older than its rows.
_CLOCKS_DIFFER_S = 86_400.0


class Assertion(NamedTuple):
    """Rows that a stage of the whole fleet asserted together, and their common stamp."""

    asserted_at: str
    day: str
    method: str = ""


def read_records(
    lake: Lake, schema: TableSchema, row_type: type[Row], *, vehicle: str | AbstractSet[str] | None = None,
    day: str | None = None, first: str | None = None, last: str | None = None,
    columns: Sequence[str] | None = None,
) -> list[Row]:  # fmt: skip
    """Records in order of vehicle, day and last assertion; `current_records` keeps the last of a key.

    Damaged or missing files are left out and listed in `lake.damage`.

    Args:
        columns: columns to read, of those with a default in `row_type`; the others keep their default. None =
            all.

    Raises:
        ContractError: the lake is of another release, or lacks a column that has no default.
    """
    wanted = _wanted(vehicle, day or first, day or last)
    found = _sorted_rows(lake, schema, row_type, wanted, columns)
    return [] if found is None else from_table(found, schema, row_type)


def read_columns(
    lake: Lake, schema: TableSchema, columns: Sequence[str], *, first: str | None, last: str | None,
    vehicle: str | AbstractSet[str] | None = None, asserted_after: str | None = None,
) -> pa.Table | None:  # fmt: skip
    """Columns of the records of a window of days, unordered, plus those that `current_rows` needs; else None.

    For thousands of vehicles, whose records would be gigabytes as rows.

    Args:
        columns: names; "diagnostics.disproved" is one value of a column of maps, null where a record has
            none.
        asserted_after: only records that became current after this moment.
    """
    asked = list(dict.fromkeys([*schema.about, "asserted_at", "work_key", *columns]))
    wanted = replace(_wanted(vehicle, first, last), asserted_after=asserted_after)
    return _rows_of(lake, schema, asked, wanted)


class RecordIndex(Generic[Row]):
    """Records of a window of days as of its creation; those of a vehicle-day become rows when requested.

    A year of a thousand vehicles is a few hundred megabytes as columns, and gigabytes as rows.
    """

    def __init__(
        self, lake: Lake, schema: TableSchema, row_type: type[Row], first: str, last: str,
        columns: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        self._schema, self._row_type = schema, row_type
        self._rows = _sorted_rows(lake, schema, row_type, Wanted(None, first, last), columns)
        self._spans: dict[tuple[str, str], tuple[int, int]] = {}
        if self._rows is not None:
            owners = zip(*(self._rows[name].to_pylist() for name in ("vehicle", "day")), strict=True)
            for owner, group in groupby(enumerate(owners), key=itemgetter(1)):
                places = [at for at, _ in group]
                self._spans[owner] = (places[0], len(places))

    def of(self, vehicle: str, day: str) -> list[Row]:
        """Rows of a vehicle-day, the last asserted last."""
        if self._rows is None or (vehicle, day) not in self._spans:
            return []
        return from_table(self._rows.slice(*self._spans[vehicle, day]), self._schema, self._row_type)


def _sorted_rows(
    lake: Lake, schema: TableSchema, row_type: type[Any], wanted: Wanted, columns: Sequence[str] | None
) -> pa.Table | None:
    """Columns in the order of `read_records`; None if there is no row."""
    known = {f.name: f for f in fields(row_type)}
    required = {n for n, f in known.items() if (f.default, f.default_factory) == (MISSING, MISSING)}
    always = required | {*schema.about, "work_key", "recorded_at", "asserted_at"}
    asked = [c.name for c in schema.columns if columns is None or c.name in always or c.name in columns]
    found = _rows_of(lake, schema, asked, wanted)
    if found is None:
        return None
    order = [(name, "ascending") for name in ("vehicle", "day", "asserted_at", *schema.about[2:], "work_key")]
    return found.take(pc.sort_indices(found, order))


def read_latest(
    lake: Lake, schema: TableSchema, row_type: type[Row], *, first: str, last: str, columns: Sequence[str]
) -> list[Row]:
    """Records of the last recorded day of each vehicle and method, in the order of `read_records`.

    That day is found from three columns; the other columns are read for those days only.
    """
    keys = _rows_of(lake, schema, ["vehicle", "method", "day"], _wanted(None, first, last))
    if keys is None:
        return []
    latest = keys.group_by(["vehicle", "method"]).aggregate([("day", "max")])
    day_of = {(row["vehicle"], row["method"]): row["day_max"] for row in latest.to_pylist()}
    found: list[Any] = []
    for day in sorted(set(day_of.values())):
        of_day: list[Any] = read_records(lake, schema, row_type, day=day, columns=columns)
        found += [row for row in of_day if day_of[row.vehicle, row.method] == day]
    return sorted(found, key=lambda row: row.vehicle)


def last_assertion(lake: Lake, schema: TableSchema, method: str | None = None) -> Assertion | None:
    """Rows of a method (None = any) that were asserted last; None if there are none.

    Files are read from the last written one on, until the others are older than the stamp found.
    """
    found: Assertion | None = None
    for file in sorted(_data_files(lake, schema), key=lambda f: f.written_s, reverse=True):
        stamp = found.asserted_at if found else None
        if stamp and file.written_s + _CLOCKS_DIFFER_S < dt.datetime.fromisoformat(stamp).timestamp():
            break
        part = read_file(lake, schema, file.name, Assertion._fields, Wanted(asserted_after=stamp))
        if part is not None and method is not None:
            part = part.filter(pc.equal(part["method"], method))
        if part is not None and part.num_rows:
            last = part.take(pc.sort_indices(part, [("asserted_at", "descending")])[:1]).to_pylist()[0]
            found = max(found or Assertion("", ""), Assertion(**last))
    return found


def read_last(
    lake: Lake, schema: TableSchema, row_type: type[Row], method: str, *,
    vehicle: str | AbstractSet[str] | None = None, columns: Sequence[str] | None = None,
) -> list[Row]:  # fmt: skip
    """Rows that a stage of the whole fleet asserted last for a method, together, by `commit_last`."""
    last = last_assertion(lake, schema, method)
    if last is None:
        return []
    rows: list[Any] = read_records(lake, schema, row_type, vehicle=vehicle, day=last.day, columns=columns)
    return [row for row in rows if (row.method, row.asserted_at) == (method, last.asserted_at)]


def read_last_columns(
    lake: Lake, schema: TableSchema, method: str, columns: Sequence[str]
) -> pa.Table | None:
    """Rows of `read_last` as columns, unordered; None if there is no such row."""
    last = last_assertion(lake, schema, method)
    found = last and read_columns(lake, schema, columns, first=last.day, last=last.day)
    if last is None or found is None:
        return None
    is_last = pc.equal(found["asserted_at"], last.asserted_at)
    return found.filter(pc.and_(pc.equal(found["method"], method), is_last))


def first_day(lake: Lake, schema: TableSchema) -> str | None:
    """First day of any record of a table, from its log; None if there is none."""
    return min((f.days[0] for f in _data_files(lake, schema) if f.days is not None), default=None)


def last_day(lake: Lake, schema: TableSchema) -> str | None:
    """Last day of any record of a table, from its log; None if there is none."""
    return max((f.days[1] for f in _data_files(lake, schema) if f.days is not None), default=None)


def _wanted(vehicle: str | AbstractSet[str] | None, first: str | None, last: str | None) -> Wanted:
    own = {vehicle} if isinstance(vehicle, str) else vehicle
    return Wanted(None if own is None else frozenset(own), first, last)


def _data_files(lake: Lake, schema: TableSchema) -> list[LiveFile]:
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


def _rows_of(lake: Lake, schema: TableSchema, columns: Sequence[str], wanted: Wanted) -> pa.Table | None:
    files = [f for f in _data_files(lake, schema) if wanted.may_be_within(f.days, f.vehicles)]
    parts = []
    for file in files:
        part = read_file(lake, schema, file.name, columns, wanted)
        if part is None:
            lake.lost.append(LostRows(schema.name, file.days, file.vehicles))
        else:
            parts.append(_chosen(part, wanted))
    parts = [p for p in parts if p.num_rows]
    if not parts:
        return None
    found = pa.concat_tables(parts, promote_options="default").combine_chunks()
    return found if all(f.in_log for f in files) else once(found, schema)


def _chosen(rows: pa.Table, wanted: Wanted) -> pa.Table:
    conditions = []
    if wanted.vehicles is not None:
        conditions.append(pc.is_in(rows["vehicle"], pa.array(sorted(wanted.vehicles), pa.string())))
    if wanted.first is not None:
        conditions.append(pc.greater_equal(rows["day"], wanted.first))
    if wanted.last is not None:
        conditions.append(pc.less_equal(rows["day"], wanted.last))
    if wanted.asserted_after is not None:
        conditions.append(pc.greater(rows["asserted_at"], wanted.asserted_after))
    return rows.filter(reduce(pc.and_, conditions)) if conditions else rows


def once(rows: pa.Table, schema: TableSchema) -> pa.Table:
    """Rows without duplicates of the same work and key (the last asserted one stays)."""
    names = [*schema.about, "work_key", "asserted_at"]
    if not set(names) <= set(rows.column_names):
        return rows
    last: dict[tuple[str, ...], tuple[str, int]] = {}
    for at, (*key, asserted) in enumerate(zip(*(rows[n].to_pylist() for n in names), strict=True)):
        last[tuple(key)] = max(last.get(tuple(key), ("", -1)), (asserted, at))
    return rows.take(pa.array(sorted(at for _, at in last.values()), pa.int64()))
