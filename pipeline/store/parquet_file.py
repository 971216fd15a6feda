"""Parquet files of a lake, opened so that no Arrow thread ever holds a Python object.

If such a thread released it during interpreter shutdown, the process would abort after its work.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.store.files import Files

__all__ = ["ParquetReader", "opened_parquet"]


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
