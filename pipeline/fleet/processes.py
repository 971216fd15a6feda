"""One function on many items: results and retries, and a pool of spawned processes that survives killed workers."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection, get_context, parent_process
from typing import Any, Generic, TypeVar

from pipeline.core.memory import MODEL_THREADS, usable_cpus
from pipeline.core.results import Progress

__all__ = ["ONE_THREAD", "Board", "Executor", "Finished", "Turns", "Watch", "attempt", "run_processes"]

# --------------------------------------------------------------------------------------------------
# One function on many items: the executor interface, the result of an item, and retries.


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


# Yields the result of each item in order of completion. The function, of an item and its progress, must be
# importable, picklable and safe to run again. Data shared by all items are bound to it (`functools.partial`),
# which each worker receives once; the items may be built on access. Number of workers None = one per available CPU.
Executor = Callable[
    [Callable[[Any, Progress], Any], Sequence[Any], int | None, Watch],
    Generator[Finished[Any, Any], None, None],
]


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


# --------------------------------------------------------------------------------------------------
# A pool of spawned processes that survives killed workers; their progress in shared memory, without locks.


_POLL_S = 0.2
_GRACE_S = 10.0  # for a worker to leave its `with` blocks; Kubernetes gives the whole pod 30 s
_TEXT_BYTES = 96


class _Slot(ctypes.Structure):
    _fields_ = (("done", ctypes.c_int64), ("total", ctypes.c_int64), ("what", ctypes.c_char * _TEXT_BYTES))


class Board:
    """One slot per item. A reader may see a half-written slot: use it for display only."""

    def __init__(self, items: int) -> None:
        self._slots = get_context("spawn").RawArray(_Slot, max(items, 1))

    def write(self, index: int, done: int, total: int, what: str) -> None:
        """Write the progress of an item."""
        slot = self._slots[index]
        slot.done, slot.total, slot.what = done, total, what.encode()[: _TEXT_BYTES - 1]

    def read(self, index: int) -> tuple[int, int, str]:
        """Last progress of an item: done, total, what."""
        slot = self._slots[index]
        return slot.done, slot.total, slot.what.decode(errors="replace")


def run_processes(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int | None, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """A pool of spawned processes (fork would copy the threads that numeric libraries hold).

    If a worker is killed, the pool is built again: waiting items go on as before, items in work are tried
    again one at a time, and an item that kills its worker twice while alone ends with an error.
    """
    board, turns = Board(len(items)), Turns(len(items))
    while turns:
        alone, queue = turns.alone, turns.queue
        size = 1 if alone else min(workers or usable_cpus(), len(queue))
        with _pool(size, function, board) as pool:
            lost = yield from _drain(pool, items, queue, size, board, watch)
        for index in lost:
            why = turns.died(index, alone=alone)
            if why:
                yield Finished(items[index], error=why)


def _drain(
    pool: ProcessPoolExecutor, items: Sequence[Item], queue: deque[int], workers: int, board: Board,
    watch: Watch,
) -> Generator[Finished[Item, Outcome], None, list[int]]:  # fmt: skip
    """Run the queue until it is empty or the pool breaks; returns the items in work when it broke."""
    running: dict[Future[Finished[Item, Outcome]], int] = {}
    while queue or running:
        # Submit no more items than workers, so that the items in work are known if the pool breaks.
        while queue and len(running) < workers:
            index = queue.popleft()
            try:
                running[pool.submit(_work, items[index], index)] = index
            except BrokenProcessPool:
                queue.appendleft(index)
                return list(running.values())
        done, _ = wait(running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        for index in running.values():
            watch(index, *board.read(index))
        broken = [f for f in done if isinstance(f.exception(), BrokenProcessPool)]
        for future in done.difference(broken):
            index = running.pop(future)
            error = future.exception()
            yield (
                replace(future.result(), item=items[index])
                if error is None
                else Finished(items[index], error=f"{type(error).__name__}: {error}")
            )
        if broken:
            return list(running.values())
    return []


@contextmanager
def _pool(
    workers: int, function: Callable[[Any, Progress], Any], board: Board
) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes have ended when the block ends, in every case."""
    own = ONE_THREAD | {MODEL_THREADS: str(max(1, usable_cpus() // workers))}
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)  # spawned processes read it while they import
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (function, board))
    try:
        yield pool
        pool.shutdown()
    finally:
        processes = list((pool._processes or {}).values())  # noqa: SLF001 - the only way to the workers
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            with suppress(OSError):
                process.terminate()
        deadline = time.monotonic() + _GRACE_S
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


_OF_THIS_WORKER: list[tuple[Callable[[Any, Progress], Any], Board]] = []


def _begin(function: Callable[[Any, Progress], Any], board: Board) -> None:
    """Prepare a worker: stop on request, leave Ctrl-C to the parent, never outlive the parent."""
    _OF_THIS_WORKER[:] = [(function, board)]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _leave(_signum: int, _frame: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signal.SIGTERM)


def _follow_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


def _work(item: Any, index: int) -> Finished[Any, Any]:
    function, board = _OF_THIS_WORKER[0]
    try:
        finished = attempt(function, item, lambda done, total, what: board.write(index, done, total, what))
    except SystemExit as err:
        # Stopped on request, with cleanup done. The pool would return this as a result and go on.
        os._exit(int(err.code or 0))
    return Finished(None, finished.value, finished.error, finished.trace)  # the parent has the item
