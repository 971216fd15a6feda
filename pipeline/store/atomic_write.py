"""Files that appear at once and whole: written aside, flushed to disk, renamed."""

from __future__ import annotations

import os
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

__all__ = ["new_file_aside", "sweep_leftovers"]

_STALE_S = (
    24 * 3600.0
)  # no vehicle-day takes a day; what is older was left by a killed writer on another machine


@contextmanager
def new_file_aside(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content replaces `path` when the block ends; on an error `path` stays as it was.

    The file aside does not end in .parquet, so that no glob of a table sees it half-written. A killed writer
    leaves it behind; the next writer in that folder takes it away.
    """
    sweep_leftovers(path.parent)
    aside = path.parent / f".writing-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex}.tmp"
    try:
        # "x" and not mkstemp: the file gets the rights that the umask says, so that others can read the lake.
        with aside.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    _flush_folder(path.parent)


def sweep_leftovers(folder: Path) -> None:
    """Remove what killed writers left: of dead processes of this machine at once, of others after a day."""
    for leftover in folder.glob(".writing-*.tmp"):
        with suppress(OSError):  # another writer may have swept it
            if _is_left_over(leftover):
                leftover.unlink()


def _is_left_over(path: Path) -> bool:
    if time.time() - path.stat().st_mtime > _STALE_S:
        return True
    host, _, rest = path.name.removeprefix(".writing-").rpartition("-")[0].rpartition("-")
    if host != socket.gethostname() or not rest.isdigit():
        return False
    try:
        os.kill(int(rest), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def _flush_folder(folder: Path) -> None:
    """Make the rename itself survive a power cut, where the file system lets a folder be flushed."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
