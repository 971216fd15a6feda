"""Where partitions and records of a lake lie: LAKE/<table>/vehicle=V/day=YYYY-MM-DD/<name>.parquet."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote, unquote

from pipeline.errors import ConfigError

__all__ = ["Lake", "Partition", "is_day", "work_key"]

_VEHICLE = re.compile(r"[^/\0=]+")


def is_day(text: str) -> bool:
    """True for a day of the calendar as YYYY-MM-DD (ISO 8601 has other spellings, the lake has one)."""
    try:
        return dt.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


@dataclass(frozen=True, order=True)
class Partition:
    """One vehicle-day, the unit of work everywhere."""

    vehicle: str
    day: str

    def __post_init__(self) -> None:
        if not _VEHICLE.fullmatch(self.vehicle) or self.vehicle in (".", ".."):
            raise ConfigError("command line", "vehicle", f"{self.vehicle!r} cannot be a vehicle's name")
        if not is_day(self.day):
            raise ConfigError("command line", "day", f"{self.day!r} is no day of the form YYYY-MM-DD")

    @property
    def folder(self) -> str:
        """Hive path below the table."""
        return f"vehicle={quote(self.vehicle, safe='')}/day={self.day}"


@dataclass(frozen=True)
class Lake:
    """The root of the tables: a folder (an object store comes behind the same methods).

    Args:
        root: the folder.
        damage: what was left out because it could not be read, as it is found: file and reason, in words.
        migrating: True for who moves the records of an older release, and meets them beside the new ones.
    """

    root: Path
    migrating: bool = False
    damage: list[str] = field(default_factory=list, compare=False, repr=False)

    @classmethod
    def at(cls, location: str | Path) -> Lake:
        """The lake at a folder; created on first write."""
        if str(location).startswith("s3://"):
            raise ConfigError("command line", "lake", "object stores are not supported yet: give a folder")
        return cls(Path(location))

    def __str__(self) -> str:
        return str(self.root)

    def folder(self, table: str, partition: Partition) -> Path:
        """The folder of one partition of one table."""
        return self.root / table / partition.folder

    def file(self, table: str, partition: Partition) -> Path:
        """The file of a partition that is replaced as a whole (records have tables of their own)."""
        return self.folder(table, partition) / "part-0.parquet"

    def partitions(self, table: str, vehicle: str | None = None, day: str | None = None) -> list[Partition]:
        """Partitions of a table that hold at least one file, in order; only those of a vehicle or day if given."""
        vehicles = "*" if vehicle is None else quote(vehicle, safe="")
        pattern = f"{table}/vehicle={vehicles}/day={day or '*'}/*.parquet"
        return sorted({p for f in self.root.glob(pattern) if (p := _partition_of(f.parent)) is not None})

    def set_aside(self, path: str) -> None:
        """Take a damaged file of a partition out of the readers' sight; it keeps its name and ends in .damaged."""
        with suppress(FileNotFoundError):
            Path(path).replace(f"{path}.damaged")

    def table(self, name: str) -> str:
        """Where a record table lies."""
        return str(self.root / name)

    def make_folder(self, table: str) -> None:
        """Make the folder of a table where it is missing."""
        (self.root / table).mkdir(parents=True, exist_ok=True)

    def exists(self) -> bool:
        """True where there is such a folder."""
        return self.root.is_dir()

    def has_record_files(self, table: str) -> bool:
        """True where a release before 0.6 left records as files in folders of vehicles."""
        return not self.migrating and any((self.root / table).glob("vehicle=*/day=*/*.parquet"))

    def record_file(self, table: str, name: str) -> Path:
        """A data file of a record table, by its name in the table's log."""
        return self.root / table / unquote(name)

    def move_record_file(self, table: str, name: str, aside: str) -> None:
        """Move a data file to another name in the table's folder, if it is there."""
        target = self.root / table / aside
        target.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            self.record_file(table, name).replace(target)

    def delta_options(self) -> dict[str, str]:
        """What `deltalake` is told of the storage."""
        return {}

    @contextmanager
    def opened(self, path: Path) -> Iterator[BinaryIO]:
        """A file, to be read at any place."""
        with path.open("rb") as stream:
            yield stream


def _partition_of(folder: Path) -> Partition | None:
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
