"""ROS 2 bag folders: all their .db3 or .mcap files, with or without metadata.yaml, compressed or not."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

import zstandard

from pipeline.core.errors import LogError, StorageError
from pipeline.ingest.containers.bounded import ZSTD_MAGIC, most_bytes
from pipeline.ingest.containers.reader import ChunkCache, LogReader, Position, RawMessage, open_log
from pipeline.ingest.containers.timeline import Stretches, Timeline
from pipeline.store.atomic_write import NO_SPACE, is_running
from pipeline.store.remote_logs import LogPath, RemoteLog

__all__ = ["CopiedLog", "FolderLog"]

# Size limit of one object, because a worker's scratch disk is small. MCAP and .bag have no limit.
_MOST_FETCHED_BYTES = 16 << 30

_UNPACKED = "boresight-unpacked-"  # followed by the id of the process that unpacked it
_LEFT_BEHIND_S = 86400.0  # longer than any log is open
_FILES = ("*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd")


class FolderLog:
    """LogReader of a folder; files that cannot be opened are counted, and the others are read."""

    def __init__(self, path: Path, cache: ChunkCache) -> None:
        self.path, self.damage = path, Counter[str]()
        self._logs: list[LogReader] = []
        self._lost = 0
        problems = []
        for file in sorted(p for pattern in _FILES for p in path.glob(pattern)):
            try:
                self._logs.append(open_log(file, cache))
            except LogError as err:
                self._lost += 1
                problems.append(str(err))
        if not self._logs:
            raise LogError(
                str(path), "; ".join(problems) or "holds no .db3 or .mcap file, so it is not a ROS 2 bag"
            )

    def timeline(self) -> Timeline | None:
        """See LogReader."""
        parts = [log.timeline() for log in self._logs]
        known = [part for part in parts if part is not None]
        return Timeline.joined(known) if len(known) == len(parts) else None

    def scan(
        self, topics: Collection[str] | None = None, within: Stretches | None = None
    ) -> Iterator[RawMessage]:
        """See LogReader."""
        self.damage.clear()
        for i, log in enumerate(self._logs):
            for m in log.scan(topics, within):
                yield RawMessage(m.channel, m.log_time_ns, (i, *m.position), m.data)
            self.damage.update(log.damage)
        if self._lost:
            self.damage["unreadable_files"] += self._lost

    def read(self, position: Position) -> memoryview:
        """See LogReader."""
        return self._logs[position[0]].read(position[1:])

    def close(self) -> None:
        """See LogReader."""
        for log in self._logs:
            log.close()


class CopiedLog:
    """LogReader of a temporary copy, which is removed on closing.

    For a file that rosbag2 compressed as a whole (.zstd), and for an object of a bucket that cannot be read in
    place: a database, or such a file.
    """

    def __init__(self, path: LogPath, cache: ChunkCache) -> None:
        _remove_left_behind()
        self._folder = tempfile.TemporaryDirectory(prefix=f"{_UNPACKED}{os.getpid()}-")
        where = Path(self._folder.name)
        try:
            copy = _unpacked(path, where) if isinstance(path, Path) else _fetched(path, where)
            self._log = open_log(copy, cache)
        except (zstandard.ZstdError, OSError, LogError) as err:
            self._folder.cleanup()
            # a problem of this machine, not of the log
            if isinstance(err, OSError) and err.errno in NO_SPACE:
                raise StorageError(str(where), f"no space left to unpack {path}") from err
            raise LogError(str(path), f"cannot be unpacked: {err}") from err
        except BaseException:
            self._folder.cleanup()
            raise
        self.path, self.damage = path, self._log.damage
        self.timeline, self.scan, self.read = self._log.timeline, self._log.scan, self._log.read

    def close(self) -> None:
        """See LogReader."""
        self._log.close()
        self._folder.cleanup()


def _unpacked(path: Path, folder: Path) -> Path:
    plain = folder / path.name.removesuffix(".zstd")
    most = most_bytes(path.stat().st_size)
    with path.open("rb") as source, plain.open("wb") as target:
        unpacked = zstandard.ZstdDecompressor().stream_reader(source)
        while block := unpacked.read(1 << 22):
            if target.tell() + len(block) > most:
                raise LogError(str(path), f"unpacks to more than {most} bytes: it is no recording")
            target.write(block)
    with plain.open("rb") as content:
        if content.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC:
            raise LogError(str(path), "is compressed twice: unpack it once")
    return plain


def _fetched(path: RemoteLog, folder: Path) -> Path:
    size, most = path.stat().st_size, _MOST_FETCHED_BYTES
    if size > most:
        what = f"has {size >> 30} GiB, and at most {most >> 30} GiB are downloaded: use MCAP"
        raise LogError(str(path), what)
    copy = folder / path.name
    with path.open("rb") as source, copy.open("wb") as target:
        shutil.copyfileobj(source, target, 1 << 24)
    return copy


def _remove_left_behind() -> None:
    """Remove a killed process's files after a day: other containers may share the folder."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_UNPACKED}*-*"):
        pid = folder.name.removeprefix(_UNPACKED).partition("-")[0]
        with suppress(FileNotFoundError):  # another process removed it first
            is_old = time.time() - folder.stat().st_mtime > _LEFT_BEHIND_S
            if pid.isdigit() and is_old and not is_running(int(pid)):
                shutil.rmtree(folder, ignore_errors=True)
