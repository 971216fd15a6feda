"""MCAP logs, read chunk by chunk: wrong checksums, lost tails and broken records cost only themselves.

Source: MCAP specification, https://mcap.dev/spec (records, chunks, summary section, footer).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from io import BytesIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Footer, Schema, Statistics

from pipeline.ingest.containers.bounded import MOST_CHUNK_BYTES
from pipeline.ingest.containers.chunked_log import ChunkedLog
from pipeline.ingest.containers.reader import (
    BYTES_AS_TEXT,
    PROTOBUF,
    READ_ERRORS,
    Channel,
    ChunkCache,
    RawMessage,
)
from pipeline.ingest.containers.timeline import Chunk
from pipeline.store.remote_logs import LogPath

__all__ = ["McapLog"]

_MAGIC_SIZE = 8
_RECORD = struct.Struct("<BQ")  # opcode, content length
_MESSAGE = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time
# Start and end time, uncompressed size and CRC, length of the compression's name.
_CHUNK = struct.Struct("<QQQII")
_FOOTER_SIZE = _RECORD.size + 20
_LAST_OPCODE = max(Opcode)


class McapLog(ChunkedLog):
    """LogReader of one .mcap file."""

    _head = _RECORD.size

    def __init__(self, path: LogPath, cache: ChunkCache) -> None:
        super().__init__(path, cache)
        self._schemas: dict[int, Schema] = {}
        self._resolved: dict[int, Channel] = {}
        # True if the summary's checksum is right: its schemas and channels then replace those of the data
        # section.
        self._trusted = False
        self._chunks = self._read_summary()
        self._chunk_starts = [c.position for c in self._chunks]
        self._lengths = {c.position + _RECORD.size: c.length - _RECORD.size for c in self._chunks}

    def _scan_all(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        for opcode, start, length in self._records():
            content = self._content(start, length)
            if opcode == Opcode.CHUNK:
                chunk = self._open_chunk(content, check=True)
                if chunk is not None:
                    self._cache.offer((str(self.path), start), chunk)
                    yield from self._scan_chunk(chunk, start, topics)
            elif opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(content)
                channel = self._wanted(channel_id, topics)
                if channel is not None:
                    position = -1, start + _MESSAGE.size, start + length
                    yield RawMessage(channel, log_time, position, memoryview(content)[_MESSAGE.size :])
            else:
                self._learn(opcode, content)

    def _chunk_at(self, start: int, *, check: bool) -> bytes | None:
        # in one read, if the summary lists it
        position, length = start - _RECORD.size, self._lengths.get(start)
        if length is None:
            length = _RECORD.unpack(self._content(position, _RECORD.size))[1]
        if length > MOST_CHUNK_BYTES:
            self.damage["oversized_chunks"] += 1
            return None
        record = self._content(position, _RECORD.size + length)
        if len(record) < _RECORD.size or _RECORD.unpack_from(record) != (Opcode.CHUNK, length):
            self.damage["damaged_records"] += 1
            return None
        return self._open_chunk(record[_RECORD.size :], check=check)

    # -- records ------------------------------------------------------------

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """(opcode, start of content, length) of records; continues at the next chunk after damage."""
        position = _MAGIC_SIZE
        while True:
            head = self._content(position, _RECORD.size)
            if len(head) < _RECORD.size:
                self.damage["truncated"] += 1
                return
            opcode, length = _RECORD.unpack(head)
            start, end = position + _RECORD.size, position + _RECORD.size + length
            next_chunk = self._next_chunk(position)
            overruns = end > self._size or (next_chunk is not None and end > next_chunk)
            is_whole = not overruns and (0 < opcode <= _LAST_OPCODE or opcode >= 0x80)
            if not is_whole or opcode in (Opcode.DATA_END, Opcode.FOOTER):
                if next_chunk is None:
                    if not is_whole:
                        self.damage["truncated" if end > self._size else "damaged_records"] += 1
                    return
                self.damage["damaged_records"] += 1
                position = next_chunk
                continue
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                if length <= MOST_CHUNK_BYTES:
                    yield opcode, start, length
                else:
                    self.damage["oversized_chunks"] += 1
            position = end

    def _read_summary(self) -> list[Chunk]:
        """Chunks listed in the summary, none if it is lost; also reads schemas, channels and counts."""
        try:
            tail = self._content(max(self._size - _FOOTER_SIZE - _MAGIC_SIZE, 0), _FOOTER_SIZE)
            footer = Footer.read(_stream(tail[_RECORD.size :]))
            summary_end = self._size - _FOOTER_SIZE - _MAGIC_SIZE
            first = max(summary_end - MOST_CHUNK_BYTES, 1)
            if tail[0] != Opcode.FOOTER or not first <= footer.summary_start < summary_end:
                return []
            summary = self._content(footer.summary_start, summary_end - footer.summary_start)
            if footer.summary_crc and zlib.crc32(summary + tail[: _FOOTER_SIZE - 4]) != footer.summary_crc:
                return []
            chunks = []
            for opcode, start, end in _inner_records(summary):
                content = summary[start:end]
                self._learn(opcode, content)
                if opcode == Opcode.CHUNK_INDEX:
                    chunks.append(_chunk_of(ChunkIndex.read(_stream(content))))
                elif opcode == Opcode.STATISTICS:
                    with suppress(*READ_ERRORS):
                        self._messages = Statistics.read(_stream(content)).channel_message_counts
            self._trusted = footer.summary_crc != 0
            return sorted((c for c in chunks if c.position < footer.summary_start), key=lambda c: c.position)
        except READ_ERRORS:
            return []

    def _learn(self, opcode: int, content: bytes) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(content))
                if not (self._trusted and schema.id in self._schemas):
                    self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = ChannelRecord.read(_stream(content))
                if not (self._trusted and channel.id in self._channels):
                    self._channels[channel.id] = channel
                    self._resolved.pop(channel.id, None)
        except READ_ERRORS:
            self.damage["damaged_records"] += 1

    # -- chunks ------------------------------------------------------------

    def _open_chunk(self, content: bytes, *, check: bool) -> bytes | None:
        """Decompressed records of the chunk, None (and counted) if it is damaged."""
        try:
            _, _, size, crc, name_length = _CHUNK.unpack_from(content)
            name_end = _CHUNK.size + name_length
            compression = content[_CHUNK.size : name_end].decode()
        except READ_ERRORS:
            self.damage["damaged_chunks"] += 1
            return None
        data = self._unpacked(compression, memoryview(content)[name_end + 8 :], size)
        if data is not None and check and crc and zlib.crc32(data) != crc:
            self.damage["damaged_chunks"] += 1
            return None
        return data

    def _scan_chunk(
        self, chunk: bytes, chunk_start: int, topics: Collection[str] | None
    ) -> Iterator[RawMessage]:
        view = memoryview(chunk)
        for opcode, start, end in _inner_records(chunk):
            if opcode == Opcode.MESSAGE and end - start >= _MESSAGE.size:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(chunk, start)
                channel = self._wanted(channel_id, topics)
                if channel is not None:
                    first = start + _MESSAGE.size
                    yield RawMessage(channel, log_time, (chunk_start, first, end), view[first:end])
            else:
                self._learn(opcode, chunk[start:end])

    def _wanted(self, channel_id: int, topics: Collection[str] | None) -> Channel | None:
        channel = self._resolved.get(channel_id)
        if channel is None:
            record = self._channels.get(channel_id)
            if record is None:
                self.damage["messages_of_unknown_channel"] += 1
                return None
            channel = self._resolved[channel_id] = _channel(record, self._schemas.get(record.schema_id))
        return channel if topics is None or channel.topic in topics else None


def _chunk_of(index: ChunkIndex) -> Chunk:
    channels = frozenset(index.message_index_offsets) or None  # a writer may leave message indexes out
    span = index.message_start_time, index.message_end_time
    return Chunk(index.chunk_start_offset, index.chunk_length, *span, channels)


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _inner_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    position, size = 0, len(data)
    while position + _RECORD.size <= size:
        opcode, length = _RECORD.unpack_from(data, position)
        start = position + _RECORD.size
        position = start + length
        if position > size:
            return
        yield opcode, start, position


def _channel(record: ChannelRecord, schema: Schema | None) -> Channel:
    if schema is None:
        return Channel(record.topic, "", record.message_encoding)
    definition_format = "idl" if schema.encoding == "ros2idl" else "msg"
    if schema.encoding == PROTOBUF:
        definition = schema.data.decode(BYTES_AS_TEXT)
        return Channel(record.topic, schema.name, record.message_encoding, definition, PROTOBUF)
    name = schema.name if schema.name.count("/") != 1 else schema.name.replace("/", "/msg/")  # ROS 1 spelling
    definition = schema.data.decode(errors="replace")
    return Channel(record.topic, name, record.message_encoding, definition, definition_format)
