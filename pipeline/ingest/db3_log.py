"""SQLite files of ROS 2 bags, read row by row in order of recording; a damaged page costs the rows on it.

Source: rosbag2_storage_sqlite3 (tables topics, messages, message_definitions since schema 4).
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

import zstandard

from pipeline.errors import LogError
from pipeline.ingest.readers import Channel, ChunkCache, Position, RawMessage

__all__ = ["Db3Log"]

# rosbag2 can compress single messages; CDR starts with a zero byte, so this is unambiguous.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MAX_MESSAGE_BYTES = 1 << 30


class Db3Log:
    """LogReader of one .db3 file."""

    def __init__(self, path: Path, _cache: ChunkCache) -> None:
        self.path, self.damage = path, Counter[str]()
        self._db = _open(path)
        self._channels = self._read_channels()

    def scan(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """See LogReader."""
        self.damage.clear()
        if Path(f"{self.path}-wal").exists() and Path(f"{self.path}-wal").stat().st_size:
            self.damage["write_ahead_log_not_merged"] += (
                1  # the recorder died: open the bag once with sqlite3 to merge
            )
        wanted = [i for i, c in self._channels.items() if topics is None or c.topic in topics]
        for row, topic_id, stamp, data in self._rows(wanted):
            payload = _payload(data)
            if payload is None or not isinstance(stamp, int):
                self.damage["damaged_rows"] += 1
                continue
            yield RawMessage(self._channels[topic_id], stamp, (row,), memoryview(payload))

    def read(self, position: Position) -> memoryview:
        """See LogReader."""
        try:
            found = self._db.execute("SELECT data FROM messages WHERE id = ?", position).fetchone()
        except sqlite3.Error as err:
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
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages "  # noqa: S608  # marks are question marks
            f"WHERE id > ? AND topic_id IN ({marks}) ORDER BY id"
        )
        last, skip = 0, 1
        limit = self._last_row()
        while last <= limit:
            try:
                for row in self._db.execute(query, (last, *wanted)):
                    last, skip = row[0], 1
                    yield row
            except (sqlite3.Error, OverflowError, UnicodeDecodeError):
                # Step over the damaged row, twice as far each time it fails again: a lost tail ends soon.
                self.damage["damaged_rows"] += 1
                last, skip = last + skip, skip * 2
            else:
                return

    def _last_row(self) -> int:
        try:
            return int(self._db.execute("SELECT max(id) FROM messages").fetchone()[0] or 0)
        except (sqlite3.Error, TypeError, ValueError):
            # The last page is lost; 2^20 rows beyond the last whole one end the scan after some 20 doublings.
            self.damage["truncated"] += 1
            return 1 << 20

    def _read_channels(self) -> dict[int, Channel]:
        try:
            topics = self._db.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except (sqlite3.Error, UnicodeDecodeError, OverflowError) as err:
            raise LogError(str(self.path), f"is no readable ROS 2 bag: {err}") from err
        definitions: dict[str, tuple[str, str]] = {}
        try:
            rows = self._db.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ).fetchall()
            definitions = {str(t): (str(text), "idl" if e == "ros2idl" else "msg") for t, e, text in rows}
        except (sqlite3.Error, UnicodeDecodeError, OverflowError):
            pass  # bags up to ROS 2 Humble carry no definitions
        return {
            int(i): Channel(str(name), str(kind), str(encoding), *definitions.get(str(kind), ("", "msg")))
            for i, name, kind, encoding in topics
            if isinstance(i, int)
        }


def _open(path: Path) -> sqlite3.Connection:
    try:
        db = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
        # Without it SQLite refuses a file shorter than its header says, as a cut-off recording is.
        # Nothing is written.
        db.execute("PRAGMA writable_schema=ON")
        db.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.Error as err:
        raise LogError(str(path), f"is no readable ROS 2 bag: {err}") from err
    return db


def _payload(data: object) -> bytes | None:
    if not isinstance(data, bytes):
        return None
    if data[:4] != _ZSTD_MAGIC:
        return data
    try:
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=_MAX_MESSAGE_BYTES)
    except zstandard.ZstdError:
        return None
