"""Record tables as Delta Lake tables: open, create, merge, read their files, and maintain them.

One folder per table, partitioned by month of the row's day. A commit is one log file that appears atomically.
So a killed writer leaves all of its rows or none, and two writers at the same time both succeed.
"""

from __future__ import annotations

import errno
import random
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from deltalake import DeltaTable, Schema, WriterProperties
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError

from pipeline.core.errors import DamagedLogError, OtherVersionError
from pipeline.store.files import opened_parquet
from pipeline.store.partitions import Lake
from schemas.columns import TableSchema
from schemas.versions import CODE_VERSION

__all__ = [
    "DAMAGED", "LOG", "LiveFile", "Wanted", "create_table", "live_files", "merge_rows", "open_table",
    "read_file", "set_aside", "set_aside_damaged", "spans_of_file", "tidy_table", "with_months",
]  # fmt: skip

_MONTH = "month"
_VERSION, _RELEASE = "boresight.version", "boresight.release"
# A reader of one vehicle's day reads whole files: 32 MB hold some thousand vehicle-days, read in a tenth of a
# second.
_FILE_BYTES = 32 << 20
# Rows of a row group: a day of a thousand vehicles has one or a few groups, and a reader of one day reads
# only these of a month's file. A group costs 20 kB of footer, a hundredth of its content.
_GROUP_ROWS = 4096
_WRITER = WriterProperties(compression="ZSTD", max_row_group_size=_GROUP_ROWS)
_FILES_A_MONTH = 8  # more small files than this are compacted after the night
# Replaced files stay for readers that began before the compaction: a week, as in Delta's own tools.
_KEEP_HOURS = 7 * 24
# Every commit of another writer costs one more try; forty in a row do not happen while others wait for
# seconds.
_TRIES = 40
_PAUSE_S = 0.05
DAMAGED = "_damaged"  # the underscore makes Delta's own tools ignore it
LOG = "_delta_log"


@dataclass(frozen=True)
class Wanted:
    """Filter of rows (None = all): vehicles, days from `first` to `last`, assertion time."""

    vehicles: frozenset[str] | None = None
    first: str | None = None
    last: str | None = None
    asserted_after: str | None = None

    def may_be_within(
        self,
        days: tuple[str, str] | None,
        vehicles: tuple[str, str] | None,
        asserted: tuple[str, str] | None = None,
    ) -> bool:
        """False if no row within these ranges can pass the filter (None: range unknown)."""
        if asserted is not None and asserted[1] <= (self.asserted_after or ""):
            return False
        if days is not None and ((self.first or "") > days[1] or (self.last or "9999") < days[0]):
            return False
        if self.vehicles is None or vehicles is None:
            return True
        return any(vehicles[0] <= vehicle <= vehicles[1] for vehicle in self.vehicles)


@dataclass(frozen=True)
class LiveFile:
    """A data file of a table's newest version, with the ranges of its days and vehicles (None: unknown)."""

    name: str
    days: tuple[str, str] | None = None
    vehicles: tuple[str, str] | None = None
    written_s: float = 0.0  # Unix time
    in_log: bool = True  # False: found without the log, so other files may hold the same rows


def with_months(rows: pa.Table, schema: TableSchema) -> pa.Table:
    """All columns of a record table's files: its own, in any order in `rows`, and the month."""
    months = pc.utf8_slice_codeunits(rows["day"], 0, 7).cast(pa.string())
    stored = _stored_schema(schema)
    return rows.append_column(_MONTH, months).select(stored.names).cast(stored)


def _stored_schema(schema: TableSchema) -> pa.Schema:
    return pa.schema([*schema.arrow_schema(), pa.field(_MONTH, pa.string(), nullable=False)])


def open_table(lake: Lake, schema: TableSchema) -> DeltaTable | None:
    """The table in its current version; None if nothing was recorded yet.

    Raises:
        DamagedLogError: the table's log cannot be read, or lacks an entry.
        ContractError: the table is of another schema version.
    """
    where = lake.table(schema.name)
    try:
        table = DeltaTable(where, storage_options=lake.files.delta_options())
    except TableNotFoundError as err:
        if any(True for _ in lake.files.find(lake.root / schema.name, "month=*/*.parquet")):
            raise DamagedLogError(where, "it is gone", str(lake)) from err
        return None
    except DeltaError as err:
        raise DamagedLogError(where, str(err).splitlines()[0], str(lake)) from err
    except OSError as err:  # its message names neither problem nor file
        raise OSError(errno.EIO, " ".join(str(err).split()), where) from err
    # deltalake ignores empty entries, which a power cut leaves behind.
    empty = [
        n for n, size in lake.files.sizes(lake.root / schema.name / LOG) if n.endswith(".json") and not size
    ]
    if empty:
        raise DamagedLogError(where, f"{', '.join(sorted(empty))} of no bytes", str(lake))
    found = table.metadata().configuration.get(_VERSION, "")
    if table.protocol().min_reader_version > 1 or found != str(schema.version):
        of, reads = (f"{schema.name}/{version}" for version in (found or "?", schema.version))
        remedy = "use that release, or a new lake"
        release = table.metadata().configuration.get(_RELEASE, "before 1.0")
        raise OtherVersionError(where, of, release, reads, remedy)
    return table


def live_files(table: DeltaTable) -> list[LiveFile]:
    """Data files of a table, with their ranges from the log."""
    actions = pa.table(table.get_add_actions(flatten=True))
    columns = {n: actions.column(n).to_pylist() for n in actions.column_names}
    nothing = [None] * actions.num_rows

    def span(name: str, i: int) -> tuple[str, str] | None:
        low, high = (columns.get(f"{end}.{name}", nothing)[i] for end in ("min", "max"))
        return None if low is None or high is None else (low, high)

    return [
        LiveFile(name, span("day", i), span("vehicle", i), columns["modification_time"][i] / 1000)
        for i, name in enumerate(columns["path"])
    ]


def read_file(
    lake: Lake, schema: TableSchema, name: str, columns: Sequence[str], wanted: Wanted | None = None
) -> pa.Table | None:
    """Requested columns that a data file has; None, with an entry in `lake.damage`, if it is unreadable.

    Args:
        columns: names; "MAP.KEY" is one value of a column of maps, as float64, null where a row has none.
        wanted: skips row groups without such rows; other rows of the remaining groups are returned too.
    """
    path, mapped = lake.record_file(schema.name, name), _mapped(columns)
    asked = [c for c in columns if "." not in c]
    # Keys of maps repeat in every row: dictionary encoding takes a fifth of the memory and time.
    coded = [f"{c}.key_value.key" for c in mapped if c not in asked]
    try:
        with opened_parquet(lake.files, path, coded) as file:
            there = [c for c in dict.fromkeys([*asked, *mapped]) if c in file.names]
            # One by one: pyarrow 26 cannot read dictionary-encoded map keys of several row groups at once.
            wanted = wanted or Wanted()
            spans = _spans(file.metadata, "day", "vehicle", "asserted_at")
            parts = [file.groups([g], there) for g, own in enumerate(spans) if wanted.may_be_within(*own)]
            table = pa.concat_tables(parts) if parts else file.groups([], there)
    except (PermissionError, pa.ArrowNotImplementedError):
        raise  # no permission is not damage: leaving the file out would hide its records from every audit
    except (pa.ArrowException, OSError, EOFError) as err:
        if not isinstance(lake.root, Path) and getattr(err, "errno", None) == errno.EIO:
            raise  # the store does not answer, which is no damage of the file
        lake.damage.append(f"{path}: {str(err).splitlines()[0]}")
        return None
    # the writer may have chosen string views for strings
    there = [c for c in there if c in asked]
    arrow = schema.arrow_schema()
    found = table.select(there).cast(pa.schema([arrow.field(c) for c in there]))
    for column, keys in mapped.items():
        for key in keys:
            maps = table[column] if column in table.column_names else None
            found = found.append_column(f"{column}.{key}", _values_of(maps, key, table.num_rows))
    return found


def _mapped(columns: Sequence[str]) -> dict[str, list[str]]:
    """Requested keys by column of maps."""
    found: dict[str, list[str]] = {}
    for column, _, key in (c.partition(".") for c in columns if "." in c):
        found.setdefault(column, []).append(key)
    return found


def spans_of_file(
    lake: Lake, schema: TableSchema, name: str
) -> tuple[tuple[str, str] | None, tuple[str, str] | None]:
    """Ranges of days and vehicles of a data file, from its footer; None if unreadable."""
    try:
        with opened_parquet(lake.files, lake.record_file(schema.name, name)) as file:
            spans = _spans(file.metadata, "day", "vehicle")
    except (pa.ArrowException, OSError):
        return None, None

    def whole(spans: list[tuple[str, str] | None]) -> tuple[str, str] | None:
        known = [s for s in spans if s is not None]
        is_whole = known and len(known) == len(spans)
        return (min(s[0] for s in known), max(s[1] for s in known)) if is_whole else None

    return whole([days for days, _ in spans]), whole([vehicles for _, vehicles in spans])


def _spans(metadata: pq.FileMetaData, *columns: str) -> list[list[tuple[str, str] | None]]:
    """For each row group, the range of each column; None if unknown."""
    place = {metadata.schema.column(i).path: i for i in range(metadata.num_columns)}
    found: list[list[tuple[str, str] | None]] = []
    for g in range(metadata.num_row_groups):
        of = [metadata.row_group(g).column(place[c]).statistics if c in place else None for c in columns]
        found.append([(s.min, s.max) if s is not None and s.has_min_max else None for s in of])
    return found


def _values_of(maps: pa.ChunkedArray | None, key: str, rows: int) -> pa.Array:
    """Values of one key of a column of maps."""
    values, begin = np.full(rows, np.nan), 0
    there = np.zeros(rows, bool)
    for chunk in maps.chunks if maps is not None else []:
        keys = chunk.keys if pa.types.is_dictionary(chunk.keys.type) else chunk.keys.dictionary_encode()
        known = keys.dictionary.to_pylist()
        if key in known:
            at = np.flatnonzero(np.asarray(keys.indices) == known.index(key))
            row = begin + np.searchsorted(np.asarray(chunk.offsets), at, side="right") - 1
            values[row], there[row] = np.asarray(chunk.items)[at], True
        begin += len(chunk)
    return pa.array(values, pa.float64(), mask=~there)


def merge_rows(lake: Lake, schema: TableSchema, rows: pa.Table, *, insert: bool = True) -> None:
    """Add rows whose work is not recorded; for others update only `asserted_at`, if it is later.

    Args:
        rows: of `with_months`, without duplicates of key and work.
        insert: False = only update `asserted_at`.

    Raises:
        ContractError: see `open_table`.
        OSError: the storage does not answer, or other writers commit all the time.
    """
    for attempt in range(_TRIES):
        try:
            table = open_table(lake, schema) or create_table(lake, schema)
            _merge(table, schema, rows, insert=insert)
        except CommitFailedError:  # another writer was first
            time.sleep(_PAUSE_S * random.uniform(1, 1 + min(attempt, 10)))
        except (DeltaError, OSError) as err:
            # move damaged files away, or no commit can succeed any more
            if not set_aside_damaged(lake, schema):
                raise OSError(f"{lake.table(schema.name)}: {err}") from err
        else:
            return
    raise OSError(f"{lake.table(schema.name)}: {_TRIES} commits of others came first: run this again")


def _merge(table: DeltaTable, schema: TableSchema, rows: pa.Table, *, insert: bool) -> None:
    days, months = (sorted(set(rows.column(n).to_pylist())) for n in ("day", _MONTH))
    # Literals, so that only files of these days are read; days and months are digits and hyphens.
    window = (
        f"t.day >= '{days[0]}' and t.day <= '{days[-1]}' and t.{_MONTH} in ({', '.join(map(repr, months))})"
    )
    same = " and ".join(f"t.{c} = s.{c}" for c in (*schema.about, "work_key"))
    # Without descriptions: those of another release may be worded otherwise, and could not be merged.
    rows = rows.cast(pa.schema([f.remove_metadata() for f in rows.schema]))
    merging = table.merge(
        rows, f"{window} and {same}", source_alias="s", target_alias="t", writer_properties=_WRITER
    ).when_matched_update({"asserted_at": "s.asserted_at"}, predicate="s.asserted_at > t.asserted_at")
    (merging.when_not_matched_insert_all() if insert else merging).execute()


def create_table(lake: Lake, schema: TableSchema) -> DeltaTable:
    """Create an empty table, unless another writer has created it meanwhile."""
    if isinstance(lake.root, Path):
        (lake.root / schema.name).mkdir(parents=True, exist_ok=True)
    return DeltaTable.create(
        lake.table(schema.name),
        Schema.from_arrow(_stored_schema(schema)),
        mode="ignore",
        partition_by=[_MONTH],
        name=schema.name,
        description=schema.doc or None,
        configuration={
            _VERSION: str(schema.version),
            _RELEASE: CODE_VERSION,
            # Keeps the log small: no query filters files by the other columns.
            "delta.dataSkippingStatsColumns": "vehicle,day",
            "delta.targetFileSize": str(_FILE_BYTES),
        },
        storage_options=lake.files.delta_options(),
        raise_if_key_not_exists=False,
    )


def set_aside_damaged(lake: Lake, schema: TableSchema) -> list[str]:
    """Move unreadable files of the table into `_damaged` next to its months; returns their names."""
    table = open_table(lake, schema)
    bad = []
    for file in live_files(table) if table is not None else []:
        if read_file(lake, schema, file.name, [c.name for c in schema.columns]) is None:
            bad.append(file.name)
            set_aside(lake, schema, file.name)
    if bad and table is not None:
        table.repair()  # removes missing files from the log
    return bad


def set_aside(lake: Lake, schema: TableSchema, name: str) -> None:
    """Move a data file, if it exists, into `_damaged`."""
    to = lake.root / schema.name / DAMAGED / name.replace("/", "_")
    lake.files.move(lake.record_file(schema.name, name), to)


def tidy_table(lake: Lake, schema: TableSchema) -> Iterator[str]:
    """Maintenance after a night: move damaged files away, compact, remove unused files; yields the actions.

    A concurrent writer only makes this compaction fail.
    """
    table = open_table(lake, schema)
    if table is None:
        return
    months = Counter(f.name.partition("/")[0].removeprefix(f"{_MONTH}=") for f in live_files(table))
    try:
        for month in sorted(m for m, count in months.items() if count > _FILES_A_MONTH):
            done: dict[str, Any] = table.optimize.compact(
                [(_MONTH, "=", month)], target_size=_FILE_BYTES, writer_properties=_WRITER
            )
            if done["numFilesRemoved"]:
                yield f"{month}: {done['numFilesRemoved']} files are {done['numFilesAdded']} now"
        table.vacuum(_KEEP_HOURS, dry_run=False)
    except CommitFailedError:
        return
    except DeltaError:
        yield from (f"set aside {name}" for name in set_aside_damaged(lake, schema))
