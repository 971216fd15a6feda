"""SQLite files of ROS 2 bags, read row by row in order of recording; a damaged page costs only its rows.

Source: rosbag2_storage_sqlite3 (tables topics, messages, message_definitions since schema 4).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
import numpy as np
import zstandard

from pipeline.core.errors import LogError
from pipeline.ingest.containers.bounded import ZSTD_MAGIC, OversizedError, most_bytes, unpack_zstd
from pipeline.ingest.containers.reader import Channel, ChunkCache, Position, RawMessage
from pipeline.ingest.containers.timeline import Counted, Stretches, Timeline

__all__ = ["Db3Log"]

_ROWS = "SELECT id, topic_id, timestamp, data FROM messages WHERE"
_DAMAGED = (apsw.Error, OverflowError, UnicodeDecodeError)
_MOST_ROWS_SKIPPED = 1 << 20  # this many consecutive unreadable rows are treated as a lost tail
# Exact counts by topic would read all rows, because there is no index of topics. A minute of a car's day has
# some thousand rows; the first rows give the share of every periodic topic.
_FIRST_ROWS = (
    "SELECT topic_id, count(*), min(timestamp) FROM "
    "(SELECT topic_id, timestamp FROM messages ORDER BY id LIMIT 20000) GROUP BY topic_id"
)


class Db3Log:
    """LogReader of one .db3 file."""

    def __init__(self, path: Path, _cache: ChunkCache) -> None:
        self.path, self.damage = path, Counter[str]()
        self._db = _open(path)
        self._channels = self._read_channels()

    def timeline(self) -> Timeline | None:
        """See LogReader. Counts by topic are extrapolated from the shares among the first rows."""
        try:
            if not self._has_time_index():
                return None
            query = "SELECT timestamp FROM messages ORDER BY timestamp"
            times = np.array([t for (t,) in self._db.execute(query)], np.int64)
            rows: Any = self._db.execute(_FIRST_ROWS).fetchall()
        except (*_DAMAGED, TypeError, ValueError):
            return None
        numbers = [(int(i), int(n), int(t)) for i, n, t in rows]
        seen = [(self._channels[i].topic, n, t) for i, n, t in numbers if i in self._channels]
        share = len(times) / max(sum(n for _, n, _ in seen), 1)
        messages = {topic: round(n * share) for topic, n, _ in seen}
        counted = {
            topic: Counted(times, times, np.broadcast_to(count / max(len(times), 1), len(times)))
            for topic, count in messages.items()
        }
        first = {topic: (t, t) for topic, _, t in seen}
        return Timeline(Stretches.of_times(times), messages, first, counted)

    def scan(
        self, topics: Collection[str] | None = None, within: Stretches | None = None
    ) -> Iterator[RawMessage]:
        """See LogReader."""
        self.damage.clear()
        if Path(f"{self.path}-wal").exists() and Path(f"{self.path}-wal").stat().st_size:
            # The recorder was killed: open the bag once with sqlite3 to merge its journal.
            self.damage["write_ahead_log_not_merged"] += 1
        wanted = [i for i, c in self._channels.items() if topics is None or c.topic in topics]
        indexed = within is not None and self._has_time_index()
        found = self._rows_in(wanted, within) if within is not None and indexed else self._rows(wanted)
        for row, topic_id, stamp, data in found:
            try:
                payload = _payload(data)
            except OversizedError:
                self.damage["oversized_rows"] += 1
                continue
            if payload is None or not isinstance(stamp, int):
                self.damage["damaged_rows"] += 1
            elif within is None or stamp in within:
                yield RawMessage(self._channels[topic_id], stamp, (row,), memoryview(payload))

    def read(self, position: Position) -> memoryview:
        """See LogReader."""
        try:
            found = self._db.execute("SELECT data FROM messages WHERE id = ?", position).fetchone()
        except apsw.Error as err:
            raise LogError(str(self.path), f"row {position[0]} cannot be read: {err}") from err
        payload = _payload(found[0]) if found else None
        if payload is None:
            raise LogError(str(self.path), "changed while it was read")
        return memoryview(payload)

    def close(self) -> None:
        """See LogReader."""
        self._db.close()

    def _rows(self, wanted: list[int]) -> Iterator[tuple[int, int, int, object]]:
        marks = ",".join("?" * len(wanted))
        query = f"{_ROWS} id > ? AND topic_id IN ({marks}) ORDER BY id"  # marks are question marks
        last, skip = 0, 1
        limit = self._last_row()
        while last <= limit and skip <= _MOST_ROWS_SKIPPED:
            try:
                for row in self._db.execute(query, (last, *wanted)):
                    last, skip = row[0], 1
                    yield row
            except _DAMAGED:
                # Skip the damaged row, and twice as many at each further failure: a lost tail ends soon.
                self.damage["damaged_rows"] += 1
                last, skip = last + skip, skip * 2
            else:
                return

    def _rows_in(self, wanted: list[int], within: Stretches) -> Iterator[tuple[int, int, int, object]]:
        """Rows logged in these stretches, found by the index; a stretch with a damaged page ends there."""
        marks = ",".join("?" * len(wanted))
        query = f"{_ROWS} timestamp BETWEEN ? AND ? AND +topic_id IN ({marks}) ORDER BY timestamp, id"
        for span in within.spans_ns:
            try:
                yield from self._db.execute(query, (*span, *wanted))
            except _DAMAGED:
                self.damage["damaged_rows"] += 1

    def _has_time_index(self) -> bool:
        """Whether there is an index on time stamps; without it each query would read all rows."""
        try:
            rows = self._db.execute("SELECT sql FROM sqlite_master WHERE type = 'index'").fetchall()
        except (apsw.Error, UnicodeDecodeError):
            return False
        made = [str(sql).replace(" ", "") for (sql,) in rows]
        return any("ONmessages(timestamp" in sql for sql in made)

    def _last_row(self) -> int:
        try:
            return int(self._db.execute("SELECT max(id) FROM messages").get or 0)
        except (apsw.Error, TypeError, ValueError):
            self.damage["truncated"] += 1  # the last page is lost
            return 2**62

    def _read_channels(self) -> dict[int, Channel]:
        try:
            topics = self._db.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except _DAMAGED as err:
            raise LogError(str(self.path), f"is not a readable ROS 2 bag: {err}") from err
        definitions: dict[str, tuple[str, str]] = {}
        with suppress(*_DAMAGED):  # bags up to ROS 2 Humble have no definitions
            rows = self._db.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ).fetchall()
            definitions = {str(t): (str(text), "idl" if e == "ros2idl" else "msg") for t, e, text in rows}
        return {
            int(i): Channel(str(name), str(kind), str(encoding), *definitions.get(str(kind), ("", "msg")))
            for i, name, kind, encoding in topics
            if isinstance(i, int)
        }


class _WholePages(apsw.VFS):
    """File system that shows only whole pages of a file, so that SQLite cannot zero-fill torn ones."""

    def __init__(self, page_size: int) -> None:
        self.name, self.page_size = f"boresight-{page_size}", page_size
        super().__init__(self.name, "")

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802
        return _WholePagesFile(name, flags, self.page_size)


class _WholePagesFile(apsw.VFSFile):
    def __init__(self, name: Any, flags: list[int], page_size: int) -> None:
        self._page_size = page_size
        super().__init__("", name, flags)

    def xFileSize(self) -> int:  # noqa: N802
        size: int = super().xFileSize()
        return size // self._page_size * self._page_size


_whole_pages = lru_cache(maxsize=8)(_WholePages)


def _open(path: Path) -> apsw.Connection:
    with path.open("rb") as stream:
        head = stream.read(18)
    size = int.from_bytes(head[16:18])
    page_size = 65536 if size == 1 else size  # SQLite file format, section 1.3.2
    is_torn = page_size >= 512 and path.stat().st_size % page_size
    try:
        db = apsw.Connection(
            f"file:{quote(str(path.absolute()))}?immutable=1",
            flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI,
            vfs=_whole_pages(page_size).name if is_torn else None,
        )
        # Without it SQLite refuses a file shorter than its header claims, such as a truncated recording.
        # Nothing is written.
        db.execute("PRAGMA writable_schema=ON")
        db.execute("SELECT count(*) FROM sqlite_master").fetchall()
    except (apsw.Error, UnicodeDecodeError) as err:
        raise LogError(str(path), f"is not a readable ROS 2 bag: {err}") from err
    return db


def _payload(data: object) -> bytes | None:
    if not isinstance(data, bytes):
        return None
    # rosbag2 can compress single messages; CDR starts with a zero byte, so this is unambiguous.
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        announced = zstandard.get_frame_parameters(data).content_size
        is_known = announced != zstandard.CONTENTSIZE_UNKNOWN
        return unpack_zstd(data, announced if is_known else most_bytes(len(data)))
    except OversizedError:
        raise
    except (zstandard.ZstdError, ValueError):
        return None
