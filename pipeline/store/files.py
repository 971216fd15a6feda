"""Files of a lake, in a folder or in a bucket: what the tables need of either."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import BinaryIO, Protocol, runtime_checkable

from pipeline.store.atomic_write import atomic_write

__all__ = ["Files", "LocalFiles"]


@runtime_checkable
class Files(Protocol):
    """A place for whole files. `pipeline/store/object_store.py` has the other one."""

    def uri(self, path: PurePath) -> str:
        """What a person, and `deltalake`, calls a file or folder."""
        ...

    def exists(self, path: PurePath) -> bool:
        """Whether there is such a file or folder."""
        ...

    def find(self, folder: PurePath, pattern: str) -> Iterator[PurePath]:
        """Files below a folder whose path matches."""
        ...

    def opened(self, path: PurePath) -> AbstractContextManager[BinaryIO]:
        """A file, to be read at any place."""
        ...

    def replacing(self, path: PurePath) -> AbstractContextManager[BinaryIO]:
        """A stream whose content replaces the file when the block ends; on an error the file stays as it was."""
        ...

    def move(self, path: PurePath, to: PurePath) -> None:
        """Give a file another name, if it is there."""
        ...

    def delete(self, path: PurePath) -> None:
        """Remove a file, if it is there."""
        ...

    def size(self, path: PurePath) -> int:
        """Bytes of a file; 0 where there is none."""
        ...

    def sizes(self, folder: PurePath) -> Iterator[tuple[str, int]]:
        """Name and bytes of each file that lies in a folder; none where there is no folder."""
        ...

    def delta_options(self) -> dict[str, str]:
        """What `deltalake` is told of the storage."""
        ...


@dataclass(frozen=True)
class LocalFiles:
    """Files of this machine, or of a mounted disk."""

    def uri(self, path: PurePath) -> str:
        """The path."""
        return str(path)

    def exists(self, path: PurePath) -> bool:
        """Whether there is such a file or folder."""
        return Path(path).exists()

    def find(self, folder: PurePath, pattern: str) -> Iterator[PurePath]:
        """Paths below a folder that match."""
        return iter(Path(folder).glob(pattern))

    @contextmanager
    def opened(self, path: PurePath) -> Iterator[BinaryIO]:
        """A file, to be read at any place."""
        with Path(path).open("rb") as stream:
            yield stream

    @contextmanager
    def replacing(self, path: PurePath) -> Iterator[BinaryIO]:
        """A stream into a file aside, which takes the name when the block ends."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(Path(path)) as stream:
            yield stream

    def move(self, path: PurePath, to: PurePath) -> None:
        """Give a file another name, if it is there."""
        Path(to).parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            Path(path).replace(to)

    def delete(self, path: PurePath) -> None:
        """Remove a file, if it is there."""
        Path(path).unlink(missing_ok=True)

    def size(self, path: PurePath) -> int:
        """Bytes of a file; 0 where there is none."""
        return Path(path).stat().st_size if Path(path).is_file() else 0

    def sizes(self, folder: PurePath) -> Iterator[tuple[str, int]]:
        """Name and bytes of each file that lies in a folder; none where there is no folder."""
        with suppress(FileNotFoundError), os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_file():
                    yield entry.name, entry.stat().st_size

    def delta_options(self) -> dict[str, str]:
        """Nothing."""
        return {}
