"""Where partitions and records of a lake lie: LAKE/<table>/vehicle=V/day=YYYY-MM-DD/<name>.parquet."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
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
    """The root of the tables: a folder (an object store comes behind the same methods)."""

    root: Path

    @classmethod
    def at(cls, location: str | Path) -> Lake:
        """The lake at a folder; created on first write."""
        if str(location).startswith("s3://"):
            raise ConfigError("command line", "lake", "object stores are not supported yet: give a folder")
        return cls(Path(location))

    def folder(self, table: str, partition: Partition) -> Path:
        """The folder of one partition of one table."""
        return self.root / table / partition.folder

    def file(self, table: str, partition: Partition) -> Path:
        """The file of a partition that is replaced as a whole (records have names of their own)."""
        return self.folder(table, partition) / "part-0.parquet"

    def partitions(self, table: str, vehicle: str | None = None, day: str | None = None) -> list[Partition]:
        """Partitions of a table that hold at least one file, in order; only those of a vehicle or day if given."""
        vehicles = "*" if vehicle is None else quote(vehicle, safe="")
        pattern = f"{table}/vehicle={vehicles}/day={day or '*'}/*.parquet"
        return sorted({p for f in self.root.glob(pattern) if (p := _partition_of(f.parent)) is not None})


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
