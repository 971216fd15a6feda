"""One function on many items: the executor interface, the result of an item, and retries."""

from __future__ import annotations

import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from pipeline.core.memory import usable_cpus
from pipeline.core.results import Progress

__all__ = ["ONE_THREAD", "Executor", "Finished", "Turns", "Watch", "attempt", "usable_cpus"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
# watch(item's index, done, total, what): progress of each item in work.
Watch = Callable[[int, int, int, str], None]

# A worker that dies also stops other items in work: each of them is tried again, alone. One death alone may
# be due to the machine (another program used up the memory); after a second the item is given up.
_DEATHS_ALONE = 2
# One thread per worker: nested thread pools compete for CPUs.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


@dataclass(frozen=True)
class Finished(Generic[Item, Outcome]):
    """Result of one item: its value, or the error in a line, with a traceback if there is one."""

    item: Item
    value: Outcome | None = None
    error: str = ""
    trace: str = ""


class Executor(Protocol):
    """`function(item, progress)` must be importable and picklable, and safe to run again.

    Data shared by all items are bound to the function (`functools.partial`), which each worker receives once;
    `items` may build each item on access. `workers` None = one per available CPU.
    """

    def __call__(
        self,
        function: Callable[[Any, Progress], Any],
        items: Sequence[Any],
        workers: int | None,
        watch: Watch,
    ) -> Generator[Finished[Any, Any], None, None]:
        """Yield the result of each item in order of completion."""
        ...


class Turns:
    """Order of work: first the fresh items, then one at a time the items whose worker died.

    An item that kills its worker twice while alone is given up, so a night loses only that item.
    """

    def __init__(self, items: int) -> None:
        self._fresh, self._suspects = deque(range(items)), deque[int]()
        self._deaths = Counter[int]()

    def __bool__(self) -> bool:
        return bool(self._fresh or self._suspects)

    @property
    def alone(self) -> bool:
        """Whether only suspects are left, which must run one at a time."""
        return not self._fresh

    @property
    def queue(self) -> deque[int]:
        """Waiting items, to be taken from the left."""
        return self._suspects if self.alone else self._fresh

    def died(self, index: int, *, alone: bool) -> str:
        """Record that a worker died with an item; returns the reason if the item is given up, else empty."""
        self._deaths[index] += alone
        if self._deaths[index] < _DEATHS_ALONE:
            self._suspects.append(index)
            return ""
        return "its worker process was killed, also when it ran alone"


def attempt(
    function: Callable[[Item, Progress], Outcome], item: Item, progress: Progress
) -> Finished[Item, Outcome]:
    """Value of the function, or its error as a result, so that it does not affect other items."""
    try:
        return Finished(item, function(item, progress))
    except Exception as err:  # noqa: BLE001 - one vehicle-day's trouble, whatever it is, must not stop the fleet
        return Finished(item, error=f"{type(err).__name__}: {err}", trace=traceback.format_exc())
