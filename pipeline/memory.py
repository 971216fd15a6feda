"""A bound on what one stage of a vehicle-day may take of the machine's memory: a bad log costs its own day only."""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import TooMuchMemoryError

__all__ = ["at_most"]

_STATUS = Path("/proc/self/status")
# How libraries that have no exception of their own for it say that memory was refused.
_REFUSED = ("bad_alloc", "bad allocation", "Failed to allocate", "allocation error")


@contextmanager
def at_most(gigabytes: float) -> Iterator[None]:
    """Within the block the process gets no more than `gigabytes` of memory beside what it has when the block begins.

    RLIMIT_DATA counts what is written to. RLIMIT_AS would count what is mapped: numba, Arrow and ONNX Runtime map
    gigabytes that they never touch. No effect where /proc does not say what the process has.

    Raises:
        TooMuchMemoryError: more was asked for.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    now = _private_bytes()
    if now:
        bounds = [b for b in (now + int(gigabytes * 2**30), soft, hard) if b >= 0]
        resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))
    try:
        yield
    except Exception as err:
        if _is_refused(err):
            raise TooMuchMemoryError(gigabytes) from err
        raise
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _private_bytes() -> int:
    """Memory that the process may write to and shares with nobody; 0 where the system does not say."""
    with suppress(OSError):
        lines = _STATUS.read_text().splitlines()
        return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:")), 0)
    return 0


def _is_refused(err: Exception) -> bool:
    if isinstance(err, MemoryError) or (isinstance(err, OSError) and err.errno == errno.ENOMEM):
        return True
    return any(words in str(err) for words in _REFUSED)
