"""Outcome of a stage, its effort, and the interface for progress."""

from __future__ import annotations

import datetime as dt
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

__all__ = ["Effort", "MadeWhenAsked", "Outcome", "Progress", "measured", "plain", "silent"]

_COUNTERS = Path("/proc/self/io")  # Linux: bytes of every read and write of the process, page cache included
# progress(done, total, what): total 0 = unknown. Stages call it often; the job decides how often to print.
Progress = Callable[[int, int, str], None]


Item = TypeVar("Item")


class MadeWhenAsked(Sequence[Item]):
    """Sequence whose items are built on access, one at a time, so that few of thousands are in memory.

    Args:
        count: number of items.
        make: builds the item of an index.
    """

    def __init__(self, count: int, make: Callable[[int], Item]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        return self._make(range(self._count)[index])


def silent(done: int, total: int, what: str) -> None:
    """Progress function that shows nothing."""


@dataclass(frozen=True)
class Effort:
    """Start of work (UTC, ISO 8601), its duration, and bytes read and written by the process meanwhile."""

    began_at: str = ""
    seconds: float = 0.0
    bytes_read: int | None = None
    bytes_written: int | None = None


@dataclass(frozen=True)
class Outcome:
    """Result of one stage on one vehicle-day, or on the fleet (then `vehicle` and `day` are empty).

    `status`: "done", "cached" (same work key, nothing to do), "refused" (recorded with a reason; the fleet
    goes on), "failed" (an error; another try may help).
    """

    stage: str
    vehicle: str
    day: str
    status: str
    work_key: str
    rows: int = 0
    kept: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    reason: str = ""
    outputs: list[str] = field(default_factory=list)
    faults: tuple[str, ...] = ()  # faults named in the reason, keys of `schemas.faults.FAULTS`
    damaged: str = ""  # path of the unreadable file, if that was the error
    inputs: tuple[str, ...] = ()
    effort: Effort = field(default=Effort(), compare=False, repr=False)
    records: tuple[Any, ...] = field(default=(), repr=False)  # rows of a record table, also for a cached day


@contextmanager
def measured() -> Iterator[Callable[[], Effort]]:
    """Measure a block: yields a function that returns the effort since the block began."""
    began_at = dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    began, before = time.perf_counter(), _bytes()

    def effort() -> Effort:
        after = _bytes()
        read, written = (
            None if a is None or b is None else a - b for a, b in zip(after, before, strict=True)
        )
        return Effort(began_at, time.perf_counter() - began, read, written)

    yield effort


def _bytes() -> tuple[int | None, int | None]:
    with suppress(OSError, ValueError, KeyError):
        counts = dict(line.split(": ") for line in _COUNTERS.read_text().splitlines())
        return int(counts["rchar"]), int(counts["wchar"])
    return None, None


def plain(value: Any) -> Any:
    """Value in strict JSON types.

    NumPy values and paths are converted; non-finite numbers (an unknown sigma) become null.
    """
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(v) for v in value]
    if isinstance(value, bool | int | str | None):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy scalars and arrays, without importing numpy here
        return plain(value.tolist())
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
