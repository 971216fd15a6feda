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

__all__ = ["Lake", "Partition", "work_key"]

_VEHICLE = re.compile(r"^[^/\0=]+$")


@dataclass(frozen=True, order=True)
class Partition:
    """One vehicle-day, the unit of work everywhere."""

    vehicle: str
    day: str

    def __post_init__(self) -> None:
        if not _VEHICLE.match(self.vehicle) or self.vehicle in (".", ".."):
            raise ConfigError("command line", "vehicle", f"{self.vehicle!r} cannot be a vehicle's name")
        try:
            dt.date.fromisoformat(self.day)
        except ValueError as err:
            raise ConfigError("command line", "day", f"{self.day!r} is no day of the form YYYY-MM-DD") from err

    @property
    def folder(self) -> str:
        """Hive path below the table."""
        return f"vehicle={quote(self.vehicle, safe='')}/day={self.day}"


@dataclass(frozen=True)
class Lake:
    """The root of the tables: a folder (an object store comes behind the same four methods)."""

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

    def partitions(self, table: str) -> list[Partition]:
        """Partitions of a table that hold at least one file, in order."""
        found = {p.parent for p in self.root.glob(f"{table}/vehicle=*/day=*/*.parquet")}
        return sorted(Partition(unquote(f.parent.name.removeprefix("vehicle=")), f.name.removeprefix("day=")) for f in found)


def work_key(stage: str, code_version: str, config: str, inputs: list[str]) -> str:
    """Hash that changes exactly when the output of a stage may change: code version, config hash and input work keys."""
    payload = json.dumps([stage, code_version, config, sorted(inputs)])
    return hashlib.sha256(payload.encode()).hexdigest()[:20]
