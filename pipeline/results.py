"""What every stage returns, what it cost, and how it says how far it is."""

from __future__ import annotations

import datetime as dt
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, overload

__all__ = ["Effort", "MadeWhenAsked", "Outcome", "Progress", "measured", "plain", "silent"]

_COUNTERS = Path("/proc/self/io")  # Linux: every read and write of the process, from the page cache too
# progress(done, total, what): total 0 = unknown. Stages call it often; the job decides what a person sees.
Progress = Callable[[int, int, str], None]


Item = TypeVar("Item")


class MadeWhenAsked(Sequence[Item]):
    """Items that are put together when their turn comes: thousands wait, and a few are in work.

    Args:
        count: of the items.
        make: puts one together, from its index.
    """

    def __init__(self, count: int, make: Callable[[int], Item]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | list[Item]:
        places = range(self._count)[index]
        return self._make(places) if isinstance(places, int) else [self._make(i) for i in places]


def silent(done: int, total: int, what: str) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Effort:
    """When work began (UTC, ISO 8601), how long it took, and the bytes that the process read and wrote meanwhile."""

    began_at: str = ""
    seconds: float = 0.0
    bytes_read: int | None = None
    bytes_written: int | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of one stage on one vehicle-day, or on the fleet (`vehicle` and `day` are empty then).

    `status`: "done", "cached" (same work key, nothing to do), "refused" (recorded with a reason; the fleet goes on),
    "failed" (an error; another try may help).
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
    faults: tuple[str, ...] = ()  # that the reason states, keys of `schemas.faults.FAULTS`
    damaged: str = ""  # the file that could not be read, where that made it fail
    inputs: tuple[str, ...] = ()
    effort: Effort = field(default=Effort(), compare=False, repr=False)
    records: tuple[Any, ...] = field(
        default=(), repr=False
    )  # rows of a record table, those of a cached day too

    def counts(self) -> dict[str, Any]:
        """What a command's summary says beside the status."""
        left_out = ("status", "records", "damaged", "inputs", "effort")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}


@contextmanager
def measured() -> Iterator[Callable[[], Effort]]:
    """A function that says the effort since the block began."""
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
    """A value as strict JSON has it: NumPy's and paths too; null for what is not finite, as an unknown sigma."""
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
    raise TypeError(f"{type(value).__name__} has no place in a JSON summary")
