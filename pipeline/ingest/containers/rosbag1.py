"""ROS 1 bags (format 2.0), read chunk by chunk; a truncated bag without index is read up to its end.

Source: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator

from pipeline.ingest.containers.bounded import MOST_CHUNK_BYTES
from pipeline.ingest.containers.chunked_log import ChunkedLog
from pipeline.ingest.containers.reader import READ_ERRORS, Channel, ChunkCache, RawMessage
from pipeline.ingest.containers.timeline import Chunk
from pipeline.store.remote_logs import LogPath

__all__ = ["BagLog"]

_FIRST_RECORD = 13  # after "#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_KNOWN = (_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION)
_U32 = struct.Struct("<I")
_PAIR = struct.Struct("<II")
_MAX_HEADER_BYTES = 1 << 20


class BagLog(ChunkedLog):
    """LogReader of one .bag file."""

    def __init__(self, path: LogPath, cache: ChunkCache) -> None:
        super().__init__(path, cache)
        self._messages: Counter[int] = Counter()  # number by connection, from the index
        self._chunks = self._read_index()
        self._chunk_starts = [c.position for c in self._chunks]

    def _scan_all(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        for position, header, start, length in self._records():
            if header["op"] == bytes([_CHUNK]):
                chunk = self._open_chunk(header, start, length)
                if chunk is not None:
                    self._cache.offer((str(self.path), position), chunk)
                    yield from self._scan_chunk(chunk, position, topics)
            elif header["op"] == bytes([_MESSAGE]):  # bags without chunks
                channel, stamp = self._message(header, topics)
                if channel is not None:
                    content = memoryview(self._content(start, length))
                    yield RawMessage(channel, stamp, (-1, start, start + length), content)
            elif header["op"] == bytes([_CONNECTION]):
                self._learn(header, self._content(start, length))

    def _chunk_at(self, start: int, *, check: bool) -> bytes | None:  # noqa: ARG002 - bags have no checksums
        record = self._record(start)
        if record is None or record[0]["op"] != bytes([_CHUNK]):
            self.damage["damaged_records"] += 1
            return None
        return self._open_chunk(*record)

    # -- records ------------------------------------------------------------

    def _record(self, position: int) -> tuple[dict[str, bytes], int, int] | None:
        """(header, start of data, its length) of a record; None if it is incomplete."""
        head = self._content(position, 4)
        if len(head) < 4:
            return None
        header_length = _U32.unpack(head)[0]
        if header_length > min(_MAX_HEADER_BYTES, self._size - position):
            return None
        raw = self._content(position + 4, header_length + 4)
        header = _fields(raw[:header_length])
        if len(raw) < header_length + 4 or header is None:
            return None
        length = _U32.unpack(raw[header_length:])[0]
        start = position + 8 + header_length
        return (header, start, length) if start + length <= self._size else None

    def _records(self) -> Iterator[tuple[int, dict[str, bytes], int, int]]:
        position = _FIRST_RECORD
        while position < self._size:
            record = self._record(position)
            next_chunk = self._next_chunk(position)
            if record is None or (next_chunk is not None and record[1] + record[2] > next_chunk):
                self.damage["truncated" if next_chunk is None else "damaged_records"] += 1
                if next_chunk is None:
                    return
                position = next_chunk
                continue
            yield position, *record
            position = record[1] + record[2]

    def _read_index(self) -> list[Chunk]:
        """Chunks in the index at the bag's end, none if it is lost; also reads connections and counts."""
        chunks: list[Chunk] = []
        try:
            first = self._record(_FIRST_RECORD)
            position = struct.unpack("<Q", first[0]["index_pos"])[0] if first is not None else 0
            while 0 < position < self._size:
                record = self._record(position)
                if record is None:
                    return []
                header, start, length = record
                if header["op"] == bytes([_CHUNK_INFO]):
                    chunks.append(self._indexed(header, self._content(start, length)))
                elif header["op"] == bytes([_CONNECTION]):
                    self._learn(header, self._content(start, length))
                position = start + length
        except READ_ERRORS:
            return []
        return sorted(chunks, key=lambda c: c.position)

    def _indexed(self, header: dict[str, bytes], counts: bytes) -> Chunk:
        """Chunk of an index record, with its message counts; its position even if the counts are damaged."""
        position = struct.unpack("<Q", header["chunk_pos"])[0]
        try:
            messages = dict(_PAIR.iter_unpack(counts))
            start, end = _time_ns(header["start_time"]), _time_ns(header["end_time"])
        except READ_ERRORS:
            return Chunk(position, 0, 0, 0, None)
        self._messages.update(messages)
        return Chunk(position, 0, start, end, frozenset(messages), messages)

    def _learn(self, header: dict[str, bytes], data: bytes) -> None:
        fields = _fields(data)
        try:
            if fields is None or len(header["conn"]) != 4:
                raise ValueError("connection")
            # some converters leave ROS 2's `/msg/` in the type
            package, *_, name = fields["type"].decode().split("/")
            if not package or package == name:
                raise ValueError("type")
            definition = fields["message_definition"].decode()
            channel = Channel(header["topic"].decode(), f"{package}/msg/{name}", "ros1", definition)
            self._channels[_U32.unpack(header["conn"])[0]] = channel
        except READ_ERRORS:
            self.damage["damaged_records"] += 1

    # -- chunks ------------------------------------------------------------

    def _open_chunk(self, header: dict[str, bytes], start: int, length: int) -> bytes | None:
        try:
            size, compression = _U32.unpack(header["size"])[0], header["compression"].decode()
        except READ_ERRORS:
            self.damage["damaged_chunks"] += 1
            return None
        return self._unpacked(compression, self._content(start, min(length, MOST_CHUNK_BYTES)), size)

    def _scan_chunk(
        self, chunk: bytes, chunk_start: int, topics: Collection[str] | None
    ) -> Iterator[RawMessage]:
        view, position, size = memoryview(chunk), 0, len(chunk)
        while position < size:
            header_length = _U32.unpack_from(chunk, position)[0] if position + 4 <= size else size
            start = position + 8 + header_length
            header = _fields(chunk[position + 4 : start - 4]) if start <= size else None
            end = size + 1 if header is None else start + _U32.unpack_from(chunk, start - 4)[0]
            if header is None or end > size:
                self.damage["damaged_records"] += 1
                return
            if header["op"] == bytes([_MESSAGE]):
                channel, stamp = self._message(header, topics)
                if channel is not None:
                    yield RawMessage(channel, stamp, (chunk_start, start, end), view[start:end])
            elif header["op"] == bytes([_CONNECTION]):
                self._learn(header, chunk[start:end])
            position = end

    def _message(
        self, header: dict[str, bytes], topics: Collection[str] | None
    ) -> tuple[Channel | None, int]:
        try:
            channel = self._channels.get(_U32.unpack(header["conn"])[0])
            stamp = _time_ns(header["time"])
        except READ_ERRORS:
            self.damage["damaged_records"] += 1
            return None, 0
        if channel is None:
            self.damage["messages_of_unknown_channel"] += 1
            return None, 0
        return (channel if topics is None or channel.topic in topics else None), stamp


def _time_ns(data: bytes) -> int:
    seconds, nanoseconds = _PAIR.unpack(data)
    return int(seconds) * 10**9 + int(nanoseconds)


def _fields(data: bytes) -> dict[str, bytes] | None:
    """`name=value` fields of a header; None if their lengths do not fit or a record has an unknown op."""
    fields: dict[str, bytes] = {}
    position = 0
    while position + 4 <= len(data):
        length = _U32.unpack_from(data, position)[0]
        name, equals, value = data[position + 4 : position + 4 + length].partition(b"=")
        position += 4 + length
        if not equals or position > len(data):
            return None
        fields[name.decode(errors="replace")] = value
    is_record = "message_definition" not in fields
    if position != len(data) or (is_record and fields.get("op", b"") not in [bytes([k]) for k in _KNOWN]):
        return None
    return fields
