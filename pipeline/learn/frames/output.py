"""Where an export goes, a folder or a bucket: its files, what each vehicle-day has written, and the plan of all."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, BinaryIO

from pipeline.learn.frames.facts import to_json
from pipeline.store.files import Files
from pipeline.store.partitions import Lake, Partition

__all__ = ["FRAMES_PER_SHARD", "Output"]

FRAMES_PER_SHARD = 128  # of a real car 100 to 250 MB: what loaders of shards advise


@dataclass(frozen=True)
class Output:
    """The root of an export, and what one vehicle-day adds to its lists.

    Args:
        root: the folder, or the prefix of a bucket.
        files: of either.
        parts: rows by the list that they belong to: shards and names of each split, rows of tables.
    """

    root: PurePath
    files: Files
    parts: dict[str, list[Any]] = field(default_factory=dict)

    @classmethod
    def at(cls, location: str) -> Output:
        """The export at a folder or at s3://BUCKET/PREFIX.

        Raises:
            ConfigError: no such place can be.
        """
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
        """A JSON file; None where there is none."""
        try:
            with self.files.opened(self.root / name) as stream:
                found: dict[str, Any] = json.loads(stream.read())
        except FileNotFoundError:
            return None
        return found

    def put(self, name: str, data: bytes, of: str = "files") -> None:
        """Write a file of a frame, which a later export of the same day may take away."""
        self.write(name, data)
        self.list(of, name)

    def list(self, part: str, row: Any) -> None:
        """Add a row to one of the lists."""
        self.parts.setdefault(part, []).append(row)

    def done(self, partition: Partition) -> dict[str, Any] | None:
        """What a finished vehicle-day says of itself."""
        return self.read(_marker(partition))

    def finish(self, partition: Partition, told: dict[str, Any]) -> None:
        """Say that a vehicle-day is finished: until then nothing of it counts."""
        self.write(_marker(partition), to_json(told))

    def forget(self, partition: Partition) -> None:
        """Take away what an earlier export wrote of a vehicle-day."""
        before = self.done(partition)
        self.files.delete(self.root / _marker(partition))
        for name in [] if before is None else before["parts"].get("files", []):
            self.files.delete(self.root / name)


def _marker(partition: Partition) -> str:
    return f"days/{partition.folder}/done.json"
