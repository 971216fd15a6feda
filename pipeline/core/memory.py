"""Limits of one stage of one vehicle-day on CPUs and memory, so that a damaged log stops its own day only."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from pipeline.core.errors import TooMuchMemoryError

__all__ = ["MODEL_THREADS", "at_most", "usable_cpus"]

# Number of CPU threads for one model; set for the workers of a night, so that no core is idle if days are
# few.
MODEL_THREADS: Final = "BORESIGHT_MODEL_THREADS"
_STATUS = Path("/proc/self/status")
# Messages of libraries that raise no exception of their own when an allocation fails.
_REFUSED = ("bad_alloc", "bad allocation", "Failed to allocate", "allocation error")


@contextmanager
def at_most(gigabytes: float) -> Iterator[None]:
    """Limit the memory of the process within the block to `gigabytes` more than at its start.

    Uses RLIMIT_DATA, which limits writable memory. RLIMIT_AS would limit mapped memory, and numba, Arrow and
    ONNX Runtime map gigabytes that they never use. No effect if /proc does not give the memory of the
    process.

    Raises:
        TooMuchMemoryError: the block needed more.
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
    """Private writable memory of the process [bytes]; 0 if the system does not report it."""
    with suppress(OSError):
        lines = _STATUS.read_text().splitlines()
        return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:")), 0)
    return 0


def _is_refused(err: Exception) -> bool:
    if isinstance(err, MemoryError) or (isinstance(err, OSError) and err.errno == errno.ENOMEM):
        return True
    return any(words in str(err) for words in _REFUSED)


def usable_cpus() -> int:
    """Number of CPUs that this process may use; in containers often fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
