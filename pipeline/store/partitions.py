"""Where partitions and records of a lake lie: LAKE/<table>/vehicle=V/day=YYYY-MM-DD/<name>.parquet."""

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

from pipeline.errors import ConfigError
from pipeline.names import is_vehicle
from pipeline.store.files import Files, LocalFiles
from pipeline.store.object_store import Bucket

__all__ = [
    "Lake", "LostRows", "Partition", "check_day", "content_hash", "days_after", "is_day", "last_possible_day",
    "months_before", "work_key",
]  # fmt: skip


def is_day(text: str) -> bool:
    """True for a day of the calendar as YYYY-MM-DD (ISO 8601 has other spellings, the lake has one)."""
    try:
        return dt.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


def check_day(name: str, day: str | None) -> None:
    """Raise ConfigError, naming the option, where a day is given that is no YYYY-MM-DD."""
    if day is not None and not is_day(day):
        raise ConfigError("command line", name, f"{day!r} is no day of the form YYYY-MM-DD")


def last_possible_day() -> str:
    """Tomorrow: elsewhere on earth it has begun; a drive of a later day cannot be."""
    return (dt.datetime.now(dt.UTC).date() + dt.timedelta(days=1)).isoformat()


def days_after(day: str, days: int) -> str:
    """The day of the calendar so many days later; earlier where `days` is negative."""
    return (dt.date.fromisoformat(day) + dt.timedelta(days=days)).isoformat()


def months_before(day: str, count: int) -> Iterator[tuple[str, str]]:
    """First and last day of what lies before a day, by month, the latest first."""
    for _ in range(count):
        end = days_after(day, -1)
        day = f"{end[:-2]}01"
        yield day, end


@dataclass(frozen=True, order=True)
class Partition:
    """One vehicle-day, the unit of work everywhere."""

    vehicle: str
    day: str

    def __post_init__(self) -> None:
        if not is_vehicle(self.vehicle):
            raise ConfigError("command line", "vehicle", f"{self.vehicle!r} cannot be a vehicle's name")
        if not is_day(self.day):
            raise ConfigError("command line", "day", f"{self.day!r} is no day of the form YYYY-MM-DD")

    @property
    def folder(self) -> str:
        """Hive path below the table."""
        return f"vehicle={quote(self.vehicle, safe='')}/day={self.day}"


@dataclass(frozen=True)
class LostRows:
    """Records that cannot be read: of these days and vehicles, first and last (None: not known)."""

    table: str
    days: tuple[str, str] | None
    vehicles: tuple[str, str] | None

    def may_be_of(self, vehicle: str) -> bool:
        """False where none of them can be of this vehicle."""
        return self.vehicles is None or self.vehicles[0] <= vehicle <= self.vehicles[1]


@dataclass(frozen=True)
class Lake:
    """The root of the tables: a folder, or a prefix of a bucket.

    Args:
        root: the folder, a `Path`; or the prefix, which is no path of this machine.
        files: where its files are.
        migrating: True for who moves the records of an older release, and meets them beside the new ones.
        damage: what was left out because it could not be read, as it is found: file and reason, in words.
        lost: whose records were in what was left out.
    """

    root: PurePath
    files: Files = field(default_factory=LocalFiles)
    migrating: bool = False
    damage: list[str] = field(default_factory=list, compare=False, repr=False)
    lost: list[LostRows] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def at(cls, location: str | Path) -> Lake:
        """The lake at a folder or at "s3://BUCKET/PREFIX"; made by the first write.

        Raises:
            ConfigError: an object store without a bucket or a prefix, or one that is not S3.
        """
        scheme, separator, rest = str(location).partition("://")
        if not separator:
            return cls(Path(location))
        bucket, _, prefix = rest.strip("/").partition("/")
        if scheme != "s3" or not bucket or not prefix:
            raise ConfigError("command line", "lake", f"{location!r} is no folder and no s3://BUCKET/PREFIX")
        return cls(PurePosixPath(prefix), Bucket(bucket))

    @classmethod
    def existing(cls, location: str | Path) -> Lake:
        """The lake at a place where there is one, for commands that read: a mistyped name is no empty lake.

        Raises:
            ConfigError: there is none, or it cannot be a lake's place (see `at`).
        """
        lake = cls.at(location)
        if not lake.exists():
            raise ConfigError("command line", "lake", f"no such folder: {location}")
        return lake

    def __str__(self) -> str:
        return self.files.uri(self.root)

    @property
    def local_root(self) -> Path:
        """The folder, for what works on folders only.

        Raises:
            ConfigError: the lake is in an object store.
        """
        if not isinstance(self.root, Path):
            raise ConfigError("command line", "lake", f"{self} is no folder, and this command needs one")
        return self.root

    def absolute(self) -> Lake:
        """The same lake, wherever a process works."""
        return replace(self, root=self.root.absolute()) if isinstance(self.root, Path) else self

    def folder(self, table: str, partition: Partition) -> PurePath:
        """The folder of one partition of one table."""
        return self.root / table / partition.folder

    def file(self, table: str, partition: Partition, sensor: str | None = None) -> PurePath:
        """The file of a partition, or the one that it has of a sensor (records have tables of their own)."""
        return self.folder(table, partition) / f"{sensor or 'part-0'}.parquet"

    def partitions(self, table: str, vehicle: str | None = None, day: str | None = None) -> list[Partition]:
        """Partitions of a table that hold at least one file, in order; only those of a vehicle or day if given."""
        vehicles = "*" if vehicle is None else quote(vehicle, safe="")
        found = self.files.find(self.root / table, f"vehicle={vehicles}/day={day or '*'}/*.parquet")
        return sorted({p for f in found if (p := _partition_of(f.parent)) is not None})

    def set_aside(self, path: str) -> None:
        """Take a damaged file of a partition out of the readers' sight; it keeps its name and ends in .damaged."""
        self.files.move(type(self.root)(path), type(self.root)(f"{path}.damaged"))

    def table(self, name: str) -> str:
        """Where a record table lies."""
        return self.files.uri(self.root / name)

    def exists(self) -> bool:
        """True where there is such a folder."""
        return self.files.exists(self.root)

    def has_record_files(self, table: str) -> bool:
        """True where a release before 0.6 left records as files in folders of vehicles."""
        found = self.files.find(self.root / table, "vehicle=*/day=*/*.parquet")
        return not self.migrating and isinstance(self.root, Path) and any(True for _ in found)

    def record_file(self, table: str, name: str) -> PurePath:
        """A data file of a record table, by its name in the table's log."""
        return self.root / table / unquote(name)


def _partition_of(folder: PurePath) -> Partition | None:
    """The partition that a folder is; None for one that nobody could have written through here."""
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
    """Hash of all that record rows say, arrays included."""
    plain = [[v.tolist() if isinstance(v, np.ndarray) else v for v in vars(row).values()] for row in rows]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:20]
