"""Run one function on many vehicle-days: inline, or in a pool of processes that survives killed workers.

A backend is a function in EXECUTORS; all yield one `Finished` per item, in order of completion, whatever
happens to the item. Only an order to stop (KeyboardInterrupt, SystemExit) ends them early, and then no worker
stays behind.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import connection, get_context, parent_process
from typing import Any, Generic, Protocol, TypeVar

from pipeline.fleet.board import Board
from pipeline.results import Progress

__all__ = ["EXECUTORS", "Executor", "Finished", "Watch"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
# watch(item's index, done, total, what): what each item in work is doing.
Watch = Callable[[int, int, int, str], None]

# A worker that dies takes innocent neighbours with it: whoever was in work then is tried again, alone. One
# death alone may still be the machine's (out of memory beside another program), a second is the item's own.
_DEATHS_ALONE = 2
_POLL_S = 0.2
_GRACE_S = 10.0  # for a worker to leave its `with` blocks; Kubernetes gives the whole pod 30 s
# One thread per worker: nested thread pools starve each other.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Finished(Generic[Item, Outcome]):
    """What became of one item: its value, or the error in a line, with a traceback where there is one."""

    item: Item
    value: Outcome | None = None
    error: str = ""
    trace: str = ""


class Executor(Protocol):
    """`function(item, progress)` must be importable and picklable, and safe to run again."""

    def __call__(
        self,
        function: Callable[[Any, Progress], Any],
        items: Sequence[Any],
        workers: int,
        watch: Watch,
    ) -> Generator[Finished[Any, Any], None, None]:
        """Yield each item's end as it comes."""
        ...


def run_inline(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """One item after the other in this process; `workers` has no meaning here."""
    del workers
    for index, item in enumerate(items):
        yield _attempt(function, item, lambda *at, i=index: watch(i, *at))


def run_processes(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """A pool of spawned processes (fork would copy the threads that numeric libraries hold).

    Where a worker is killed, the pool is built anew: items that had not begun go on as before, items that
    were in work are tried again one at a time, and one that kills its worker twice alone ends with an error.
    """
    board = Board(len(items))
    fresh, suspects = deque(range(len(items))), deque[int]()
    deaths = dict.fromkeys(range(len(items)), 0)
    while fresh or suspects:
        alone = not fresh
        queue = suspects if alone else fresh
        size = 1 if alone else min(workers, len(fresh))
        with _pool(size, board) as pool:
            lost = yield from _drain(pool, function, items, queue, size, board, watch)
        for index in lost:
            deaths[index] += alone
            if deaths[index] < _DEATHS_ALONE:
                suspects.append(index)
            else:
                yield Finished(items[index], error="its worker process was killed, also when it ran alone")


EXECUTORS: dict[str, Executor] = {"inline": run_inline, "process": run_processes}


def _drain(
    pool: ProcessPoolExecutor,
    function: Callable[[Item, Progress], Outcome],
    items: Sequence[Item],
    queue: deque[int],
    workers: int,
    board: Board,
    watch: Watch,
) -> Generator[Finished[Item, Outcome], None, list[int]]:
    """Run the queue until it is empty or the pool breaks; returns what was in work when it broke."""
    running: dict[Future[Finished[Item, Outcome]], int] = {}
    while queue or running:
        # No more than there are workers, so that what is in work when the pool breaks is known.
        while queue and len(running) < workers:
            index = queue.popleft()
            try:
                running[pool.submit(_work, function, items[index], index)] = index
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
def _pool(workers: int, board: Board) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes are gone when the block ends, however it ends."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # spawned processes read it while they import
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (board,))
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


_BOARD: list[Board] = []  # of this worker


def _begin(board: Board) -> None:
    """Prepare a worker: stop when told, leave Ctrl-C to the parent, never outlive it."""
    _BOARD[:] = [board]
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


def _work(function: Callable[[Item, Progress], Outcome], item: Item, index: int) -> Finished[Any, Outcome]:
    board = _BOARD[0]
    try:
        finished = _attempt(function, item, lambda done, total, what: board.write(index, done, total, what))
    except SystemExit as err:
        # Told to stop, and everything is put away. The pool would send this back as a result and go on.
        os._exit(int(err.code or 0))
    return Finished(None, finished.value, finished.error, finished.trace)  # the parent has the item


def _attempt(
    function: Callable[[Item, Progress], Outcome], item: Item, progress: Progress
) -> Finished[Item, Outcome]:
    try:
        return Finished(item, function(item, progress))
    except Exception as err:  # noqa: BLE001 - one vehicle-day's trouble, whatever it is, must not stop the fleet
        return Finished(item, error=f"{type(err).__name__}: {err}", trace=traceback.format_exc())
