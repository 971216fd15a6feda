"""Destination of an export, a folder or a bucket: its files, the rows of each vehicle-day, the plan."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, BinaryIO

from pipeline.learn.frames.frame import day_key, to_json
from pipeline.store.files import Files
from pipeline.store.partitions import Lake, Partition
from schemas.training import SPLITS

__all__ = ["DayOutput", "Output"]

_FOLDERS = ("samples", "labels", *SPLITS)  # where formats put the files of frames


@dataclass(frozen=True)
class Output:
    """Root of an export: a folder, or a prefix of a bucket."""

    root: PurePath
    files: Files

    @classmethod
    def at(cls, location: str) -> Output:
        """The export at a folder or at s3://BUCKET/PREFIX; raises ConfigError if the place is invalid."""
        lake = Lake.at(location)
        return cls(lake.root, lake.files)

    def replacing(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A stream whose content becomes the file of that name as a whole."""
        return self.files.replacing(self.root / name)

    def write(self, name: str, data: bytes) -> None:
        """Replace a file."""
        with self.replacing(name) as stream:
            stream.write(data)

    def read(self, name: str) -> dict[str, Any] | None:
        """A JSON file, or None."""
        try:
            with self.files.opened(self.root / name) as stream:
                found: dict[str, Any] = json.loads(stream.read())
        except FileNotFoundError:
            return None
        return found

    def delete(self, name: str) -> None:
        """Remove a file, if it exists."""
        self.files.delete(self.root / name)

    def done(self, partition: Partition) -> dict[str, Any] | None:
        """Summary of a finished vehicle-day."""
        return self.read(_of(partition, "done.json"))

    def finish(self, partition: Partition, told: dict[str, Any]) -> None:
        """Mark a vehicle-day as finished; before, none of its frames count."""
        self.write(_of(partition, "done.json"), to_json(told))
        self.delete(_of(partition, "begun.json"))

    def rows(self, partition: Partition) -> Iterator[tuple[str, Any]]:
        """Rows of a vehicle-day, each with the name of its list; one row is in memory."""
        try:
            with self.files.opened(self.root / _of(partition, "rows.jsonl")) as stream:
                for line in stream:
                    name, row = json.loads(line)
                    yield name, row
        except FileNotFoundError:
            return

    @contextmanager
    def writing(self, partition: Partition) -> Iterator[DayOutput]:
        """Output of a vehicle-day in place of its earlier files; an error leaves none of the new ones."""
        self._forget(partition)
        self.write(_of(partition, "begun.json"), b"{}")
        try:
            with self.replacing(_of(partition, "rows.jsonl")) as stream:
                yield DayOutput(self, stream)
        except BaseException:
            with suppress(OSError):  # the next run does it
                self._forget(partition)
            raise

    def _forget(self, partition: Partition) -> None:
        """Remove the files of a vehicle-day, finished or stopped anywhere. The marker goes first."""
        self.delete(_of(partition, "done.json"))
        for part, name in self.rows(partition):
            if part == "files":
                self.delete(name)
        self.delete(_of(partition, "rows.jsonl"))
        if self.read(_of(partition, "begun.json")) is not None:
            # Files of a killed writer are named by the day's key.
            own = re.compile(re.escape(day_key(partition)) + r"[_-]\d{6,}")
            for path in [p for folder in _FOLDERS for p in self.files.find(self.root / folder, "**/*")]:
                if own.fullmatch(path.name.partition(".")[0]):
                    self.files.delete(path)
            self.delete(_of(partition, "begun.json"))


@dataclass(frozen=True)
class DayOutput:
    """Output of one vehicle-day: files, and rows that are written to disk one by one."""

    output: Output
    stream: BinaryIO

    def replacing(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A stream whose content becomes the file of that name as a whole."""
        return self.output.replacing(name)

    def put(self, name: str, data: bytes) -> None:
        """Write a file of a frame."""
        self.output.write(name, data)
        self.list("files", name)

    def list(self, part: str, row: Any) -> None:
        """Add a row to one of the lists."""
        self.stream.write(to_json([part, row]) + b"\n")


def _of(partition: Partition, name: str) -> str:
    return f"days/{partition.folder}/{name}"
