"""File operations of a lake: in a folder here, in a bucket with the same methods in `object_store.py`.

Parquet files are opened so that no Arrow thread ever holds a Python object: if such a thread released it during
interpreter shutdown, the process would abort after its work.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.store.atomic_write import atomic_write
from pipeline.store.object_store import Bucket

__all__ = ["Files", "LocalFiles", "ParquetReader", "opened_parquet"]


@dataclass(frozen=True)
class LocalFiles:
    """Files of this machine, or of a mounted disk."""

    def uri(self, path: PurePath) -> str:
        """Address of a file or folder for users and for `deltalake`: its path."""
        return str(path)

    def exists(self, path: PurePath) -> bool:
        """Whether the file or folder exists."""
        return Path(path).exists()

    def find(self, folder: PurePath, pattern: str) -> Iterator[PurePath]:
        """Paths below a folder that match a pattern."""
        return iter(Path(folder).glob(pattern))

    def opened(self, path: PurePath) -> BinaryIO:
        """A file opened for random access."""
        return Path(path).open("rb")

    @contextmanager
    def replacing(self, path: PurePath) -> Iterator[BinaryIO]:
        """A stream into a temporary file, which replaces the file when the block ends."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(Path(path)) as stream:
            yield stream

    def move(self, path: PurePath, to: PurePath) -> None:
        """Rename a file, if it exists."""
        Path(to).parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            Path(path).replace(to)

    def delete(self, path: PurePath) -> None:
        """Remove a file, if it exists."""
        Path(path).unlink(missing_ok=True)

    def size(self, path: PurePath) -> int:
        """Size of a file [bytes]; 0 if it does not exist."""
        return Path(path).stat().st_size if Path(path).is_file() else 0

    def sizes(self, folder: PurePath) -> Iterator[tuple[str, int]]:
        """Name and size [bytes] of each file in a folder; empty if the folder does not exist."""
        with suppress(FileNotFoundError), os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_file():
                    yield entry.name, entry.stat().st_size

    def delta_options(self) -> dict[str, str]:
        """Storage options for `deltalake`: none."""
        return {}


Files = LocalFiles | Bucket


class ParquetReader:
    """Reader of one file; if its source is a Python object, it reads only in the caller's thread."""

    def __init__(self, file: pq.ParquetFile, *, threads: bool) -> None:
        self._file, self._threads = file, threads
        self.metadata: pq.FileMetaData = file.metadata

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(self._file.schema_arrow.names)

    def groups(self, groups: list[int], columns: list[str] | None = None) -> pa.Table:
        """Columns of row groups; all columns if none are given."""
        return self._file.read_row_groups(groups, columns=columns, use_threads=self._threads)


@contextmanager
def opened_parquet(
    files: Files, path: PurePath, read_dictionary: list[str] | None = None
) -> Iterator[ParquetReader]:
    """A Parquet file of a folder or a bucket.

    Raises:
        FileNotFoundError: it does not exist.
        OSError: the storage does not answer, or the file is damaged.
        pyarrow.ArrowException: the file is damaged.
    """
    if isinstance(path, Path):
        with pa.OSFile(str(path)) as source, pq.ParquetFile(source, read_dictionary=read_dictionary) as file:
            yield ParquetReader(file, threads=True)
    else:
        # pre-buffering would read it in threads
        with (
            files.opened(path) as source,
            pq.ParquetFile(source, read_dictionary=read_dictionary, pre_buffer=False) as file,
        ):
            yield ParquetReader(file, threads=False)
