"""Atomic files: written under a temporary name, flushed to disk, renamed."""

from __future__ import annotations

import errno
import os
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

__all__ = ["NO_SPACE", "atomic_write", "is_running", "naming"]

# No vehicle-day takes a day: an older temporary file was left by a killed writer on another machine.
_ABANDONED_S = 24 * 3600.0
# To list a folder of 10,000 files before each takes longer than to write them; by folder and process.
_LARGE = 200
_large: set[tuple[Path, int]] = set()
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # a disk, a quota or a limit is exhausted


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content replaces `path` when the block ends; on an error `path` stays as it was.

    The temporary file does not end in .parquet, so that no glob of a table matches it. A killed writer leaves
    it behind; the next writer in that folder removes it, in a large folder the next process that writes there.
    """
    owner = path.parent, os.getpid()
    if owner not in _large and _remove_abandoned(path.parent) > _LARGE:
        _large.add(owner)
    temporary = path.parent / f".writing-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex}.tmp"
    try:
        # "x" and not mkstemp: the file gets the permissions of the umask, so that others can read the lake.
        with naming(path), temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _flush_folder(path.parent)


@contextmanager
def naming(path: object) -> Iterator[None]:
    """Add the path to an OSError for lack of space; errors of writes to an open file have none."""
    try:
        yield
    except OSError as err:
        if err.errno not in NO_SPACE or err.filename is not None:
            raise
        raise OSError(err.errno, os.strerror(err.errno), str(path)) from err


def _remove_abandoned(folder: Path) -> int:
    """Remove files of killed writers: of this machine at once, others after a day; returns the number of files."""
    files = list(folder.iterdir())
    for temporary in files:
        if temporary.name.startswith(".writing-") and temporary.suffix == ".tmp":
            with suppress(OSError):  # another writer may have removed it
                if _is_abandoned(temporary):
                    temporary.unlink()
    return len(files)


def _is_abandoned(temporary: Path) -> bool:
    if time.time() - temporary.stat().st_mtime > _ABANDONED_S:
        return True
    host, _, process = temporary.name.removeprefix(".writing-").rpartition("-")[0].rpartition("-")
    return host == socket.gethostname() and process.isdigit() and not is_running(int(process))


def is_running(process: int) -> bool:
    """Whether there is a process with this id, of any user."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, PermissionError) as err:
        return isinstance(err, PermissionError)
    return True


def _flush_folder(folder: Path) -> None:
    """Make the rename survive a power cut, if the file system can flush a folder."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
