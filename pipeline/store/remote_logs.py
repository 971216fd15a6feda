"""Logs in a bucket with the interface of files; only the requested bytes are fetched."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from pipeline.core.errors import ConfigError, StorageError
from pipeline.store.object_store import Bucket

__all__ = ["LogPath", "RangeReader", "RemoteLog", "find_remote_logs", "log_at"]

_AHEAD_BYTES = 1 << 16  # added to small reads: record headers and footers follow each other


class _About(NamedTuple):
    st_size: int


@dataclass(frozen=True, order=True)
class RemoteLog:
    """A log in a bucket, with the part of `Path`'s interface that log readers use.

    Methods raise StorageError if the store does not answer: never OSError, which readers treat as damage.
    """

    bucket: str
    key: str
    listed: tuple[int, str] | None = field(
        default=None, compare=False
    )  # size and tag, if a listing gave them

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.key}"

    @property
    def name(self) -> str:
        """Last part of the key."""
        return PurePosixPath(self.key).name

    @property
    def identity(self) -> str:
        """Name, size and entity tag, which changes with the content."""
        size, tag = self._size_and_tag
        return f"{self.name}:{size}:{tag}"

    def exists(self) -> bool:
        """Whether the object exists."""
        with suppress(FileNotFoundError):
            return self._size_and_tag[0] >= 0
        return False

    def stat(self) -> _About:
        """Size of the object [bytes]."""
        return _About(self._size_and_tag[0])

    def open(self, mode: str) -> RangeReader:
        """Open for random access."""
        assert mode == "rb", "logs are read"
        return RangeReader(self)

    def content(self, start: int, length: int) -> bytes:
        """Bytes from a position on."""
        try:
            return Bucket(self.bucket).read_range(PurePosixPath(self.key), start, length)
        except OSError as err:
            raise StorageError(str(self), str(err)) from err

    @cached_property
    def _size_and_tag(self) -> tuple[int, str]:
        if self.listed is not None:
            return self.listed
        try:
            return Bucket(self.bucket).size_and_tag(PurePosixPath(self.key))
        except FileNotFoundError:
            raise
        except OSError as err:
            raise StorageError(str(self), str(err)) from err


LogPath = Path | RemoteLog


class RangeReader(io.RawIOBase):
    """A stream that fetches what is read; small reads fetch some of the following bytes too."""

    def __init__(self, log: RemoteLog) -> None:
        super().__init__()
        self._log, self._size, self._at = log, log.stat().st_size, 0
        self._start, self._held = 0, b""

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move the position; fetches nothing."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Position of the next read."""
        return self._at

    def seekable(self) -> bool:
        """Whether random access works: always true here."""
        return True

    def readable(self) -> bool:
        """Whether it can be read: always true here."""
        return True

    def read(self, size: int = -1) -> bytes:
        """The next `size` bytes, fewer at the end."""
        left = max(self._size - self._at, 0)
        size = left if size < 0 else min(size, left)
        begin = self._at - self._start
        if not 0 <= begin <= begin + size <= len(self._held):
            held = self._log.content(self._at, min(max(size, _AHEAD_BYTES), left)) if size else b""
            self._start, self._held, begin = self._at, held, 0
        got = self._held[begin : begin + size]
        self._at += len(got)
        if len(self._held) > _AHEAD_BYTES:
            self._held = b""
        return got


def log_at(place: str) -> LogPath:
    """The log at a path or at "s3://BUCKET/KEY"; raises ConfigError if it is neither."""
    scheme, separator, rest = place.partition("://")
    if not separator:
        return Path(place)
    bucket, _, key = rest.partition("/")
    if scheme != "s3" or not bucket or not key:
        raise ConfigError("command line", "LOG", f"{place!r} is neither a file nor s3://BUCKET/KEY")
    return RemoteLog(bucket, key)


def find_remote_logs(prefix: str) -> Iterator[RemoteLog]:
    """All objects whose names begin with "s3://BUCKET/FOLDER/", in order of key."""
    bucket, _, folder = prefix.removeprefix("s3://").partition("/")
    try:
        for key, size, tag in Bucket(bucket).listed(PurePosixPath(folder)):
            yield RemoteLog(bucket, key, (size, tag))
    except OSError as err:
        raise StorageError(prefix, str(err)) from err
