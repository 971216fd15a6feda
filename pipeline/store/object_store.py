"""Objects of an S3 bucket as files: atomic writes, random access, listings; transient faults are retried.

Credentials, region and endpoint come only from the environment (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`,
`AWS_REGION`, `AWS_ENDPOINT_URL`, `AWS_ALLOW_HTTP`, ...), as `obstore` and `deltalake` read them.
"""

from __future__ import annotations

import errno
import io
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import cache
from itertools import takewhile
from pathlib import PurePath, PurePosixPath
from typing import Any, BinaryIO, cast

import obstore
from obstore.exceptions import BaseError, NotFoundError
from obstore.store import S3Store

from pipeline.store.atomic_write import naming

__all__ = ["Bucket"]

# A slower request is repeated: a healthy store answers one of 8 MiB within a second.
REQUEST_S = 30.0
CONNECT_S = 5.0
# S3 asks clients to back off for seconds when it answers 503; a longer outage is an error.
RETRIES = 10
RETRY_S = 180.0
_BUFFER_BYTES = 1 << 20  # of a reader: a Parquet footer or the pages of a small column in one request

_ABSENT = (NotFoundError, FileNotFoundError)  # the client raises either


@dataclass(frozen=True)
class Bucket:
    """A bucket whose objects are used as files, with the methods of `LocalFiles`."""

    name: str

    def uri(self, key: PurePath) -> str:
        """Address of an object for users."""
        return f"s3://{self.name}/{key}"

    def exists(self, key: PurePath) -> bool:
        """Whether the object exists, or any object below that key."""
        with self._as_os_errors(key):
            try:
                obstore.head(_store(self.name), str(key))
            except _ABSENT:
                return next(self.find(key, "**/*"), None) is not None
        return True

    def find(self, folder: PurePath, pattern: str) -> Iterator[PurePath]:
        """Keys below a folder that match a pattern with as many parts; all keys if it begins with **."""
        parts = pattern.split("/")
        literal = list(takewhile(lambda part: not set(part) & set("*?["), parts))
        for key, _, _ in self.listed(folder.joinpath(*literal)):
            below = PurePosixPath(key).relative_to(folder).parts
            if parts[0] == "**" or (len(below) == len(parts) and all(map(fnmatchcase, below, parts))):
                yield folder.joinpath(*below)

    @contextmanager
    def opened(self, key: PurePath) -> Iterator[BinaryIO]:
        """A reader of an object, which fetches only the requested bytes; raises OSError."""
        with self._as_os_errors(key):
            reader = obstore.open_reader(_store(self.name), str(key), buffer_size=_BUFFER_BYTES)
        yield cast("BinaryIO", io.BufferedReader(_Reader(self, key, reader), _BUFFER_BYTES))

    def read_range(self, key: PurePath, start: int, length: int) -> bytes:
        """Byte range of an object, fetched by one request; raises OSError."""
        with self._as_os_errors(key):
            return bytes(obstore.get_range(_store(self.name), str(key), start=start, length=length))

    def size_and_tag(self, key: PurePath) -> tuple[int, str]:
        """Size [bytes] and entity tag of an object, which changes with the content; raises OSError."""
        with self._as_os_errors(key):
            about = obstore.head(_store(self.name), str(key))
            return int(about["size"]), str(about["e_tag"])

    def listed(self, folder: PurePath) -> Iterator[tuple[str, int, str]]:
        """Key, size and tag of all objects below a folder, in order of key; raises OSError."""
        prefix = "" if str(folder) == "." else f"{folder}/"
        with self._as_os_errors(folder):
            for page in obstore.list(_store(self.name), prefix or None, chunk_size=1000):
                for item in page:
                    yield str(item["path"]), int(item["size"]), str(item["e_tag"])

    @contextmanager
    def replacing(self, key: PurePath) -> Iterator[BinaryIO]:
        """A stream whose content becomes the object when the block ends; on an error the object stays.

        The content is first written to a local file, so that readers of the store see the whole object or none.
        """
        with naming(tempfile.gettempdir()), tempfile.TemporaryFile() as stream:
            yield cast("BinaryIO", stream)
            stream.seek(0)
            with self._as_os_errors(key):
                obstore.put(_store(self.name), str(key), stream)

    def move(self, key: PurePath, to: PurePath) -> None:
        """Rename an object, if it exists."""
        with suppress(FileNotFoundError), self._as_os_errors(key):
            obstore.rename(_store(self.name), str(key), str(to))

    def delete(self, key: PurePath) -> None:
        """Remove an object, if it exists."""
        with suppress(FileNotFoundError), self._as_os_errors(key):
            obstore.delete(_store(self.name), str(key))

    def size(self, key: PurePath) -> int:
        """Size of an object [bytes]; 0 if it does not exist."""
        with suppress(FileNotFoundError):
            return self.size_and_tag(key)[0]
        return 0

    def sizes(self, folder: PurePath) -> Iterator[tuple[str, int]]:
        """Name and size [bytes] of each object directly below a key."""
        for key, size, _ in self.listed(folder):
            name = PurePosixPath(key).relative_to(folder)
            if len(name.parts) == 1:
                yield str(name), size

    def delta_options(self) -> dict[str, str]:
        """Retry settings for `deltalake`, equal to those of this client."""
        return {
            "timeout": f"{REQUEST_S:g}s",
            "connect_timeout": f"{CONNECT_S:g}s",
            "max_retries": str(RETRIES),
            "retry_timeout": f"{RETRY_S:g}s",
        }

    @contextmanager
    def _as_os_errors(self, key: PurePath) -> Iterator[None]:
        """Raise the store's errors as OSErrors with a number, so that they are not mistaken for damaged files."""
        try:
            yield
        except _ABSENT as err:
            raise FileNotFoundError(errno.ENOENT, "no such object", self.uri(key)) from err
        except BaseError as err:
            raise OSError(errno.EIO, str(err).splitlines()[0], self.uri(key)) from err


class _Reader(io.RawIOBase):
    """obstore's reader with the interface of Python's and Arrow's readers."""

    def __init__(self, bucket: Bucket, key: PurePath, reader: Any) -> None:
        super().__init__()
        self._bucket, self._key, self._reader = bucket, key, reader

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._reader.seek(offset, whence))

    def tell(self) -> int:
        return int(self._reader.tell())

    def readinto(self, buffer: Any) -> int:
        with self._bucket._as_os_errors(self._key):  # noqa: SLF001 - of this module
            got = bytes(self._reader.read(len(buffer)))
        buffer[: len(got)] = got
        return len(got)


def _store(bucket: str) -> S3Store:
    """Client of a bucket, cached per set of environment variables (store, credentials)."""
    return _client(bucket, tuple(sorted(item for item in os.environ.items() if item[0].startswith("AWS_"))))


@cache
def _client(bucket: str, environment: tuple[tuple[str, str], ...]) -> S3Store:  # noqa: ARG001 - tells clients apart
    return S3Store(
        bucket,
        client_options={
            "timeout": timedelta(seconds=REQUEST_S),
            "connect_timeout": timedelta(seconds=CONNECT_S),
            # With any option given, the client reads none of them from the environment.
            "allow_http": os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true"),
        },
        retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_S)},
    )
