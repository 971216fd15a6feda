"""Writing of records: rows are added and never replaced; of several rows with the same key one is current.

`commit_records` recognises work that is recorded already and never duplicates it.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pyarrow.compute as pc

from pipeline.store.delta import merge_rows, with_months
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns, read_last_columns
from pipeline.store.rows import to_table
from schemas.columns import TableSchema

__all__ = ["assert_records", "commit_last", "commit_records"]


def commit_records(lake: Lake, schema: TableSchema, rows: Iterable[Any]) -> int:
    """Add records as one commit, and make them current for their keys; returns how many changed.

    A row whose work is recorded already is not added again; if another row became current since, the recorded
    one becomes current once more. `recorded_at` and `asserted_at` are set here unless the row has them.

    Raises:
        ContractError: the lake is of another release, or a row breaks its table's contract.
        OSError: the storage does not answer.
    """
    unique = {schema.about_of(row) + (row.work_key,): row for row in rows}
    return _commit(lake, schema, list(unique.values()), insert=True)


def commit_last(lake: Lake, schema: TableSchema, rows: Sequence[Any]) -> int:
    """Add rows of a stage of the whole fleet, with one stamp later than any before; see `read_last`.

    Returns the number of rows that became current; 0 if the same rows were the last already. Raises as
    `commit_records`.
    """
    if not rows:
        return 0
    known = read_last_columns(lake, schema, rows[0].method, ())
    keys = [] if known is None else known["work_key"].to_pylist()
    if sorted(keys) == sorted(row.work_key for row in rows):
        return 0
    stamp = _after(dt.datetime.now(dt.UTC), "" if known is None else pc.max(known["asserted_at"]).as_py())
    return commit_records(lake, schema, [replace(row, asserted_at=stamp) for row in rows])


def assert_records(lake: Lake, schema: TableSchema, rows: Sequence[Any]) -> int:
    """Make recorded rows current again if others became current since; returns how many did."""
    unstamped = [replace(row, recorded_at="", asserted_at="") for row in rows]
    return _commit(lake, schema, unstamped, insert=False)


def _commit(lake: Lake, schema: TableSchema, rows: Sequence[Any], *, insert: bool) -> int:
    """Make rows current, those that are not recorded only with `insert`; returns how many changed."""
    known = _known(lake, schema, rows)
    now = dt.datetime.now(dt.UTC)
    changed = []
    for row in rows:
        rivals = known.get(schema.about_of(row), {})
        latest = max(rivals.values(), default="")
        given = row.asserted_at or row.recorded_at
        if max(rivals[row.work_key], given) == latest if row.work_key in rivals else not insert:
            continue
        stamp = given or _after(now, latest)
        changed.append(replace(row, recorded_at=row.recorded_at or stamp, asserted_at=stamp))
    if changed:
        table = to_table(sorted(changed, key=lambda r: (r.vehicle, r.day)), schema)
        merge_rows(lake, schema, with_months(table, schema), insert=insert)
    return len(changed)


def _known(lake: Lake, schema: TableSchema, rows: Sequence[Any]) -> Mapping[tuple[str, ...], dict[str, str]]:
    """Recorded rows by key: work key to `asserted_at`."""
    if not rows:
        return {}
    vehicles, days = {row.vehicle for row in rows}, {row.day for row in rows}
    one = vehicles if len(vehicles) == 1 else None
    columns = [*schema.about, "work_key", "asserted_at"]
    found = read_columns(lake, schema, (), first=min(days), last=max(days), vehicle=one)
    known: dict[tuple[str, ...], dict[str, str]] = {}
    if found is not None:
        values = [found.column(name).to_pylist() for name in columns]
        for *about, work_key, asserted_at in zip(*values, strict=True):
            of_work = known.setdefault(tuple(about), {})
            of_work[work_key] = max(of_work.get(work_key, ""), asserted_at)
    return known


def _after(now: dt.datetime, latest: str) -> str:
    """Now, or a moment after `latest` if that is in the future of this machine's clock."""
    if latest >= _iso(now):
        return _iso(dt.datetime.fromisoformat(latest) + dt.timedelta(microseconds=1))
    return _iso(now)


def _iso(stamp: dt.datetime) -> str:
    return stamp.astimezone(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
