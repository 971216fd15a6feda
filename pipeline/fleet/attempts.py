"""One function on many items: what is asked of an executor, how an item ends, and when it is given up."""

from __future__ import annotations

import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from pipeline.memory import usable_cpus
from pipeline.results import Progress

__all__ = ["ONE_THREAD", "Executor", "Finished", "Turns", "Watch", "attempt", "usable_cpus"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
# watch(item's index, done, total, what): what each item in work is doing.
Watch = Callable[[int, int, int, str], None]

# A worker that dies takes innocent neighbours with it: whoever was in work then is tried again, alone. One
# death alone may still be the machine's (out of memory beside another program), a second is the item's own.
_DEATHS_ALONE = 2
# One thread per worker: nested thread pools starve each other.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


@dataclass(frozen=True)
class Finished(Generic[Item, Outcome]):
    """What became of one item: its value, or the error in a line, with a traceback where there is one."""

    item: Item
    value: Outcome | None = None
    error: str = ""
    trace: str = ""


class Executor(Protocol):
    """`function(item, progress)` must be importable and picklable, and safe to run again.

    What all items share is bound to the function (`functools.partial`), which each worker is sent once; `items` may
    put each item together when it is asked for. `workers` None = one per CPU that may be used.
    """

    def __call__(
        self,
        function: Callable[[Any, Progress], Any],
        items: Sequence[Any],
        workers: int | None,
        watch: Watch,
    ) -> Generator[Finished[Any, Any], None, None]:
        """Yield each item's end as it comes."""
        ...


class Turns:
    """Whose turn it is: first the fresh items, then one at a time those whose worker died.

    An item that kills its worker twice alone is given up, so that one item at most is lost to it.

    Args:
        items: how many there are.
    """

    def __init__(self, items: int) -> None:
        self._fresh, self._suspects = deque(range(items)), deque[int]()
        self._deaths = Counter[int]()

    def __bool__(self) -> bool:
        return bool(self._fresh or self._suspects)

    @property
    def alone(self) -> bool:
        """Whether only suspects are left, each of which must be the only one in work."""
        return not self._fresh

    @property
    def queue(self) -> deque[int]:
        """Who waits, to be taken from the left."""
        return self._suspects if self.alone else self._fresh

    def died(self, index: int, *, alone: bool) -> str:
        """Note that a worker died with an item: empty where the item gets another turn, else why it gets none."""
        self._deaths[index] += alone
        if self._deaths[index] < _DEATHS_ALONE:
            self._suspects.append(index)
            return ""
        return "its worker process was killed, also when it ran alone"


def attempt(
    function: Callable[[Item, Progress], Outcome], item: Item, progress: Progress
) -> Finished[Item, Outcome]:
    """The function's value, or its error: one item's trouble stays its own."""
    try:
        return Finished(item, function(item, progress))
    except Exception as err:  # noqa: BLE001 - one vehicle-day's trouble, whatever it is, must not stop the fleet
        return Finished(item, error=f"{type(err).__name__}: {err}", trace=traceback.format_exc())
