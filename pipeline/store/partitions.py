"""Paths of partitions and records of a lake: LAKE/<table>/vehicle=V/day=YYYY-MM-DD/<name>.parquet."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.core.names import is_vehicle
from pipeline.store.files import Files, LocalFiles
from pipeline.store.object_store import Bucket

__all__ = [
    "Lake", "LostRows", "Partition", "check_day", "content_hash", "days_after", "is_day", "last_possible_day",
    "months_before", "work_key",
]  # fmt: skip


def is_day(text: str) -> bool:
    """Whether a text is a calendar day as YYYY-MM-DD (the only spelling in a lake; ISO 8601 has others)."""
    try:
        return dt.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


def check_day(name: str, day: str | None) -> None:
    """Raise ConfigError, naming the option, for a day that is not YYYY-MM-DD."""
    if day is not None and not is_day(day):
        raise ConfigError("command line", name, f"{day!r} is not a day of the form YYYY-MM-DD")


def last_possible_day() -> str:
    """Tomorrow, because some time zones are ahead; a later day of a drive is impossible."""
    return (dt.datetime.now(dt.UTC).date() + dt.timedelta(days=1)).isoformat()


def days_after(day: str, days: int) -> str:
    """Calendar day so many days later; earlier if `days` is negative."""
    return (dt.date.fromisoformat(day) + dt.timedelta(days=days)).isoformat()


def months_before(day: str, count: int) -> Iterator[tuple[str, str]]:
    """First and last day of each month before a day, the latest first."""
    for _ in range(count):
        end = days_after(day, -1)
        day = f"{end[:-2]}01"
        yield day, end


@dataclass(frozen=True, order=True)
class Partition:
    """One vehicle-day, the unit of work of most stages."""

    vehicle: str
    day: str

    def __post_init__(self) -> None:
        if not is_vehicle(self.vehicle):
            raise ConfigError("command line", "vehicle", f"{self.vehicle!r} cannot be a vehicle's name")
        check_day("day", self.day)

    @property
    def folder(self) -> str:
        """Hive path of the partition below the table."""
        return f"vehicle={quote(self.vehicle, safe='')}/day={self.day}"


@dataclass(frozen=True)
class LostRows:
    """Ranges of days and vehicles of unreadable records, first and last (None: unknown)."""

    table: str
    days: tuple[str, str] | None
    vehicles: tuple[str, str] | None

    def may_be_of(self, vehicle: str) -> bool:
        """False if none of them can be of this vehicle."""
        return self.vehicles is None or self.vehicles[0] <= vehicle <= self.vehicles[1]


@dataclass(frozen=True)
class Lake:
    """Root of the tables: a folder, or a prefix of a bucket.

    Args:
        damage: filled while reading: file and reason of everything left out because it is unreadable.
        lost: days and vehicles of the records left out.
    """

    root: PurePath
    files: Files = field(default_factory=LocalFiles)
    damage: list[str] = field(default_factory=list, compare=False, repr=False)
    lost: list[LostRows] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def at(cls, location: str | Path) -> Lake:
        """The lake at a folder or "s3://BUCKET/PREFIX", made by the first write; ConfigError if invalid."""
        scheme, separator, rest = str(location).partition("://")
        if not separator:
            return cls(Path(location))
        bucket, _, prefix = rest.strip("/").partition("/")
        if scheme != "s3" or not bucket or not prefix:
            raise ConfigError(
                "command line", "lake", f"{location!r} is neither a folder nor s3://BUCKET/PREFIX"
            )
        return cls(PurePosixPath(prefix), Bucket(bucket))

    @classmethod
    def existing(cls, location: str | Path) -> Lake:
        """The existing lake at a location, for commands that read; ConfigError for a mistyped name."""
        lake = cls.at(location)
        if not lake.exists():
            raise ConfigError("command line", "lake", f"no such folder: {location}")
        return lake

    def __str__(self) -> str:
        return self.files.uri(self.root)

    @property
    def local_root(self) -> Path:
        """The folder, for code that works on folders only; ConfigError for an object store."""
        if not isinstance(self.root, Path):
            raise ConfigError("command line", "lake", f"{self} is not a folder, and this command needs one")
        return self.root

    def absolute(self) -> Lake:
        """The same lake with an absolute path, for processes in other working folders."""
        return replace(self, root=self.root.absolute()) if isinstance(self.root, Path) else self

    def folder(self, table: str, partition: Partition) -> PurePath:
        """Folder of one partition of one table."""
        return self.root / table / partition.folder

    def file(self, table: str, partition: Partition, sensor: str | None = None) -> PurePath:
        """File of a partition, or its file of a sensor (records have tables of their own)."""
        return self.folder(table, partition) / f"{sensor or 'part-0'}.parquet"

    def partitions(self, table: str) -> list[Partition]:
        """Partitions of a table with at least one file, in order."""
        found = self.files.find(self.root / table, "vehicle=*/day=*/*.parquet")
        return sorted({p for f in found if (p := _partition_of(f.parent)) is not None})

    def set_aside(self, path: str) -> None:
        """Hide a damaged file of a partition from readers by adding .damaged to its name."""
        self.files.move(type(self.root)(path), type(self.root)(f"{path}.damaged"))

    def table(self, name: str) -> str:
        """Location of a record table."""
        return self.files.uri(self.root / name)

    def exists(self) -> bool:
        """Whether the folder exists."""
        return self.files.exists(self.root)

    def record_file(self, table: str, name: str) -> PurePath:
        """Data file of a record table, by its name in the table's log."""
        return self.root / table / unquote(name)


def _partition_of(folder: PurePath) -> Partition | None:
    """Partition of a folder; None if its name is not valid."""
    try:
        return Partition(
            unquote(folder.parent.name.removeprefix("vehicle=")), folder.name.removeprefix("day=")
        )
    except ConfigError:
        return None


def work_key(stage: str, code_version: str, config: str, inputs: list[str]) -> str:
    """Hash that changes exactly when a stage's output may change: code version, config hash, input work keys."""
    payload = json.dumps([stage, code_version, config, sorted(inputs)])
    return hashlib.sha256(payload.encode()).hexdigest()[:20]


def content_hash(rows: Sequence[Any]) -> str:
    """Hash of the content of record rows, arrays included."""
    found = hashlib.sha256(b"[")
    for k, row in enumerate(rows):  # one by one: the text of a fleet's rows would be hundreds of megabytes
        plain = [v.tobytes().hex() if isinstance(v, np.ndarray) else v for v in vars(row).values()]
        found.update((", " * (k > 0) + json.dumps(plain)).encode())
    found.update(b"]")
    return found.hexdigest()[:20]
