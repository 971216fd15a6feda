"""Common code for MCAP files and ROS 1 bags: both hold chunks, with an index at the end of the file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import zstandard

from pipeline.core.errors import LogError
from pipeline.ingest.containers.bounded import OversizedError, unpack
from pipeline.ingest.containers.reader import READ_ERRORS, ChunkCache, Position, RawMessage
from pipeline.ingest.containers.timeline import Chunk, Stretches, Timeline, timeline_of_chunks
from pipeline.store.remote_logs import LogPath

__all__ = ["ChunkedLog"]


class ChunkedLog(ABC):
    """LogReader of a file of chunks; the cache keeps the most recently decompressed chunks."""

    _head = 0  # offset within a chunk's record from which positions of messages count

    def __init__(self, path: LogPath, cache: ChunkCache) -> None:
        self.path, self.damage = path, Counter[str]()
        self._cache, self._file = cache, path.open("rb")
        self._size = path.stat().st_size
        self._channels: dict[int, Any] = {}  # connections or channels by id; each has a topic
        self._messages: Mapping[int, int] = {}  # number by channel, from the index
        self._chunks: list[Chunk] = []  # from the index
        self._chunk_starts: list[int] = []

    def timeline(self) -> Timeline | None:
        """See LogReader."""
        if not self._chunks or not self._messages:
            return None
        topics = {number: channel.topic for number, channel in self._channels.items()}
        return timeline_of_chunks(self._chunks, topics, self._messages)

    def scan(
        self, topics: Collection[str] | None = None, within: Stretches | None = None
    ) -> Iterator[RawMessage]:
        """See LogReader."""
        self.damage.clear()
        if within is None:
            return self._scan_all(topics)
        found = self._scan_in(topics, within) if self._chunks else self._scan_all(topics)
        return (m for m in found if m.log_time_ns in within)

    def read(self, position: Position) -> memoryview:
        """See LogReader."""
        chunk_start, start, end = position
        if chunk_start < 0:
            return memoryview(self._content(start, end - start))
        chunk = self._cache.get((str(self.path), chunk_start))
        if chunk is None:
            chunk = self._chunk_at(chunk_start, check=False)
            if chunk is None or len(chunk) < end:
                raise LogError(str(self.path), "changed while it was read")
            self._cache.put((str(self.path), chunk_start), chunk)
        return memoryview(chunk)[start:end]

    def close(self) -> None:
        """See LogReader."""
        self._file.close()

    def _scan_in(self, topics: Collection[str] | None, within: Stretches) -> Iterator[RawMessage]:
        wanted = {n for n, channel in self._channels.items() if topics is None or channel.topic in topics}
        for indexed in self._chunks:
            if not within.touch(indexed.start_ns, indexed.end_ns):
                continue
            if indexed.channels is not None and not indexed.channels & wanted:
                continue
            start = indexed.position + self._head
            chunk = self._cache.get((str(self.path), start)) or self._chunk_at(start, check=True)
            if chunk is not None:
                self._cache.offer((str(self.path), start), chunk)
                yield from self._scan_chunk(chunk, start, topics)

    def _content(self, start: int, length: int) -> bytes:
        self._file.seek(start)
        return self._file.read(length)

    def _unpacked(self, compression: str, packed: bytes | memoryview, size: int) -> bytes | None:
        """Content of a chunk; None (and counted) if it is damaged."""
        try:
            return unpack(compression, packed, size)
        except OversizedError:
            self.damage["oversized_chunks"] += 1
        except (*READ_ERRORS, zstandard.ZstdError):
            self.damage["damaged_chunks"] += 1
        return None

    def _next_chunk(self, position: int) -> int | None:
        i = bisect_right(self._chunk_starts, position)
        return self._chunk_starts[i] if i < len(self._chunk_starts) else None

    @abstractmethod
    def _scan_all(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """Messages of the whole file, in file order."""

    @abstractmethod
    def _scan_chunk(self, chunk: bytes, start: int, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """Messages of a chunk."""

    @abstractmethod
    def _chunk_at(self, start: int, *, check: bool) -> bytes | None:
        """Decompressed records of a chunk, with or without their checksum; None (and counted) if it is damaged."""
