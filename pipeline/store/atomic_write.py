"""Files that appear at once and whole: written under a temporary name, flushed to disk, renamed."""

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

__all__ = ["NO_SPACE", "atomic_write", "naming", "remove_abandoned"]

# No vehicle-day takes a day: what is older was left by a killed writer on another machine.
_ABANDONED_S = 24 * 3600.0
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # a disk, a quota or a limit is used up


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content replaces `path` when the block ends; on an error `path` stays as it was.

    The temporary file does not end in .parquet, so that no glob of a table sees it half-written. A killed writer
    leaves it behind; the next writer in that folder removes it.
    """
    remove_abandoned(path.parent)
    temporary = path.parent / f".writing-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex}.tmp"
    try:
        # "x" and not mkstemp: the file gets the rights that the umask says, so that others can read the lake.
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
    """Let an error for want of space say where: what writes to an open file does not know its name.

    Raises:
        OSError: with the path.
    """
    try:
        yield
    except OSError as err:
        if err.errno not in NO_SPACE or err.filename is not None:
            raise
        raise OSError(err.errno, os.strerror(err.errno), str(path)) from err


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of killed writers: of this machine's dead processes at once, of others after a day."""
    for temporary in folder.glob(".writing-*.tmp"):
        with suppress(OSError):  # another writer may have removed it
            if _is_abandoned(temporary):
                temporary.unlink()


def _is_abandoned(temporary: Path) -> bool:
    if time.time() - temporary.stat().st_mtime > _ABANDONED_S:
        return True
    host, _, process = temporary.name.removeprefix(".writing-").rpartition("-")[0].rpartition("-")
    if host != socket.gethostname() or not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
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
