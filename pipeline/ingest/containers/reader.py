"""One interface for MCAP, ROS 1 and ROS 2 bags: scan once for an index, then read messages by position.

Every backend reads the records of its container in file order and never a whole file. So damage costs only
the damaged part, and the chunk cache bounds memory for any length of log. `damage` counts unreadable parts.
"""

from __future__ import annotations

import hashlib
import importlib
import struct
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from pipeline.core.errors import LogError
from pipeline.ingest.containers.bounded import ZSTD_MAGIC
from pipeline.ingest.containers.timeline import Stretches, Timeline
from pipeline.store.remote_logs import LogPath, RemoteLog

__all__ = [
    "BACKENDS", "BYTES_AS_TEXT", "PROTOBUF", "READ_ERRORS", "Channel", "ChunkCache", "LogReader", "Position",
    "RawMessage", "content_identity", "leads_nowhere", "open_log",
]  # fmt: skip

# Position of a message in its log; its meaning is private to the backend.
Position = tuple[int, ...]
PROTOBUF = "protobuf"  # name of the encoding in MCAP, for messages and schemas
BYTES_AS_TEXT = "latin-1"  # one character for each byte and back, for definitions that are not text


@dataclass(frozen=True)
class Channel:
    """A stream of messages in a log.

    `encoding` is "cdr", "ros1" or "protobuf" (others cannot be decoded); `definition` is the embedded schema,
    "" if there is none; `definition_format` is "msg", "idl" or "protobuf" (BYTES_AS_TEXT).
    """

    topic: str
    msgtype: str
    encoding: str
    definition: str = ""
    definition_format: str = "msg"


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as logged; `data` is valid until the scan yields the next message."""

    channel: Channel
    log_time_ns: int
    position: Position
    data: memoryview


@runtime_checkable
class LogReader(Protocol):
    """Interface of a backend; `damage` counts unreadable parts by name and is complete after a scan."""

    path: LogPath
    damage: Counter[str]

    def timeline(self) -> Timeline | None:
        """Timeline from the log's index, without reading messages; None without a trustworthy index."""

    def scan(
        self, topics: Collection[str] | None = None, within: Stretches | None = None
    ) -> Iterator[RawMessage]:
        """All complete messages of the topics (None = every topic) in file order.

        `within` selects stretches of log time; if the log has an index, only their chunks are read.
        """

    def read(self, position: Position) -> memoryview:
        """Payload of a message found by a scan; raises LogError if the log changed since the scan."""

    def close(self) -> None:
        """Close all files."""


# Reader by first bytes of the file, independent of its name; resolved on use.
BACKENDS: dict[str, str] = {
    ".mcap": "pipeline.ingest.containers.mcap:McapLog",
    ".bag": "pipeline.ingest.containers.rosbag1:BagLog",
    ".db3": "pipeline.ingest.containers.rosbag2_sqlite:Db3Log",
    ".zstd": "pipeline.ingest.containers.rosbag2_folder:CopiedLog",
    "folder": "pipeline.ingest.containers.rosbag2_folder:FolderLog",
    "fetched": "pipeline.ingest.containers.rosbag2_folder:CopiedLog",
}
_BY_RANGES = (".mcap", ".bag")  # logs in buckets that are read in place, by byte ranges
_MAGIC = {b"\x89MCAP": ".mcap", b"#ROSBAG": ".bag", b"SQLite format 3\0": ".db3", ZSTD_MAGIC: ".zstd"}
# Errors of container libraries for damaged bytes; backends turn them into counted damage or a LogError.
READ_ERRORS = (
    ValueError,
    KeyError,
    IndexError,
    OSError,
    EOFError,
    OverflowError,
    RuntimeError,
    ArithmeticError,
    AssertionError,
    struct.error,
)


def open_log(path: LogPath, cache: ChunkCache | None = None) -> LogReader:
    """Reader of a log: an .mcap, .bag or .db3 file on disk or in a bucket, or a ROS 2 bag folder.

    Raises:
        LogError: no such file, or another type of file.
        StorageError: the object store does not answer.
    """
    kind = _kind(path)
    if isinstance(path, RemoteLog) and kind not in _BY_RANGES:
        kind = "fetched"
    module, name = BACKENDS[kind].split(":")
    backend = getattr(importlib.import_module(module), name)
    return backend(path, cache or ChunkCache())


def content_identity(path: LogPath) -> str:
    """Identity of a log for work keys: name, size, hash of samples; in a bucket name, size, entity tag.

    The hash covers the first and last MiB of each file and 64 samples of 4 KiB evenly between. A full hash
    would read terabytes of a fleet even if there is nothing to do. Logs are written once, and an appended,
    recovered, re-indexed or re-recorded log differs in size, head or tail. Modification times are not used:
    copies differ in them.
    """
    if isinstance(path, RemoteLog):
        return path.identity
    if leads_nowhere(path):
        raise LogError(str(path), f"is a link to {path.readlink()}, which does not exist")
    if path.exists() and not (path.is_dir() or path.is_file()):
        raise LogError(str(path), "is neither a file nor a folder")
    digest = hashlib.sha256(path.name.encode())
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    try:
        for file in files:
            size = file.stat().st_size
            digest.update(f"{file.relative_to(path) if path.is_dir() else ''}\0{size}\0".encode())
            with file.open("rb") as stream:
                for start, length in _samples(size):
                    stream.seek(start)
                    digest.update(stream.read(length))
    except OSError as err:
        raise LogError(str(path), f"cannot be read: {err}") from err
    return f"{path.name}:{digest.hexdigest()[:24]}"


def leads_nowhere(path: LogPath) -> bool:
    """Whether a log is a link whose target is not there, as when a disk is not mounted."""
    return isinstance(path, Path) and path.is_symlink() and not path.exists()


class ChunkCache:
    """Decompressed chunks of all open logs, the oldest dropped first: bounds the memory of readers."""

    def __init__(self, max_bytes: int = 128 << 20) -> None:
        self._max_bytes, self._bytes = max_bytes, 0
        self._chunks: OrderedDict[tuple[str, int], bytes] = OrderedDict()

    def get(self, key: tuple[str, int]) -> bytes | None:
        """The chunk; None if it was dropped."""
        chunk = self._chunks.get(key)
        if chunk is not None:
            self._chunks.move_to_end(key)
        return chunk

    def offer(self, key: tuple[str, int], chunk: bytes) -> None:
        """Keep a chunk if there is room: a short day then needs no second decompression."""
        if self._bytes + len(chunk) <= self._max_bytes and key not in self._chunks:
            self.put(key, chunk)

    def put(self, key: tuple[str, int], chunk: bytes) -> None:
        """Keep a chunk; at least the last one is kept, of any size."""
        self._chunks[key] = chunk
        self._bytes += len(chunk)
        while self._bytes > self._max_bytes and len(self._chunks) > 1:
            _, dropped = self._chunks.popitem(last=False)
            self._bytes -= len(dropped)


def _kind(path: LogPath) -> str:
    if isinstance(path, Path):
        if path.is_dir():
            return "folder"
        if path.exists() and not path.is_file():
            raise LogError(str(path), "is neither a file nor a folder")  # opening a pipe would block for ever
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError as err:
        raise LogError(str(path), f"cannot be read: {err.strerror}") from err
    if not head:
        raise LogError(str(path), "is empty")
    for magic, kind in _MAGIC.items():
        # Half of the magic bytes are enough: a flipped bit must not make the whole log unreadable.
        if 2 * sum(a == b for a, b in zip(head, magic, strict=False)) > len(magic):
            return kind
    raise LogError(
        str(path), "is not a log that Boresight reads: an .mcap, .bag or .db3 file, or a ROS 2 bag folder"
    )


def _samples(size: int) -> list[tuple[int, int]]:
    mib, block, count = 1 << 20, 4096, 64
    if size <= 2 * mib + count * block:
        return [(0, size)]
    step = (size - 2 * mib) // count
    return [(0, mib), *((mib + i * step, block) for i in range(count)), (size - mib, mib)]
