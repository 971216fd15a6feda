"""Items as plain tasks of a Ray cluster: the one in $RAY_ADDRESS, or a small one on this machine.

Ray runs every task in a process of its own, so a dead worker affects no other task. If a node is lost, its
tasks are tried again elsewhere, without blame. Needs the extra [ray]; see README.md in this folder.
"""

from __future__ import annotations

import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.results import Progress
from pipeline.fleet.processes import ONE_THREAD, Finished, Turns, Watch, attempt, usable_cpus
from pipeline.fleet.ray_cluster import Cluster, connected, sigterm_between_calls
from schemas.versions import CODE_VERSION

__all__ = ["run_on_ray"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

# Memory limit of a worker in DESIGN, for logs of any length (long_log.json of 62eb5928: 455 MB).
_MEMORY_BYTES = 2 << 30
# Two tasks per CPU: the second waits for the first, and shows an autoscaler that more nodes have work.
_TASKS_PER_CPU = 2
# An item that was in work on this many lost nodes may be the cause: it goes on alone. If spot nodes disappear
# during a vehicle-day's minute one time in a hundred, this affects one item in a million, and costs only
# time.
_NODES_LOST = 3
_POLL_S = 0.2
# between reads of the board, and between progress reports of a task: they all go to one process
_LOOK_S = 0.5
_COUNT_S = 5.0  # between counts of the nodes
_GRACE_S = 10.0  # for a worker to leave its `with` blocks, as in a pool
_NO_NODE_S = 600.0  # Kubernetes provides a node within minutes, or never


def run_on_ray(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int | None, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """Tasks of one CPU and 2 GiB each, at most `workers` in flight (None = two per CPU of the cluster).

    An item whose worker is killed is tried again alone, as in a pool of processes.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: the cluster cannot be reached, or has had no node large enough for a task for ten
            minutes.
    """
    if not items:
        return
    cluster, turns = connected(workers or usable_cpus()), Turns(len(items))
    with sigterm_between_calls() as obey:
        crew = _Crew(cluster, function, items, watch)
        try:
            while turns:
                alone = turns.alone
                suspects = yield from crew.drain(turns.queue, 1 if alone else workers, obey)
                for index in suspects:
                    why = turns.died(index, alone=alone)
                    if why:
                        yield Finished(items[index], error=why)
        finally:
            crew.leave()


class _Crew:
    """Tasks in flight, with the state of the tasks and of their nodes.

    Args:
        function: of all tasks; put into the object store once.
        watch: called with the progress of each item.
    """

    def __init__(
        self, cluster: Cluster, function: Callable[[Any, Progress], Any], items: Sequence[Any], watch: Watch
    ) -> None:
        self._ray, self._items, self._watch = cluster.ray, items, watch
        # on a single machine `workers` limits the memory
        self._memory = _MEMORY_BYTES if cluster.is_shared else 0
        self._function = self._ray.put(function)
        self._board = cluster.beside_the_driver(_Board)
        self._reading, self._read_at = self._board.read.remote(), time.monotonic()
        self._task = self._ray.remote(_work).options(
            num_cpus=1,
            memory=self._memory or None,
            max_retries=0,  # Ray would retry a poisoned item beside the others
            runtime_env={"env_vars": cluster.environment | ONE_THREAD},
        )
        self._running: dict[Any, int] = {}
        self._nodes_lost = Counter[int]()
        self._cpus, self._counted_at, self._room_at = 1, 0.0, time.monotonic()

    def drain(
        self, queue: deque[int], most: int | None, obey: Callable[[], None]
    ) -> Generator[Finished[Any, Any], None, list[int]]:
        """Run the queue until it is empty; returns the items that must go on alone."""
        suspects: list[int] = []
        while queue or self._running:
            self._count()
            while queue and len(self._running) < (most or _TASKS_PER_CPU * self._cpus):
                index = queue.popleft()
                task = self._function, self._items[index], index, self._board, CODE_VERSION
                self._running[self._task.remote(*task)] = index
            ended = self._ended()
            obey()
            self._tell()
            for ref in ended:
                index = self._running.pop(ref)
                end = self._end(ref, index)
                if end is not None:
                    yield replace(end, item=self._items[index])
                elif self._nodes_lost[index] in range(1, _NODES_LOST):
                    queue.append(index)
                else:
                    suspects.append(index)
        return suspects

    def leave(self) -> None:
        """Stop the tasks in work, with time for cleanup."""
        waiting = list(self._running)
        with suppress(Exception):  # the night ends here, even if the cluster is broken
            for force in (False, True):
                for ref in waiting:
                    self._ray.cancel(ref, force=force)
                if waiting:
                    _, waiting = self._ray.wait(waiting, num_returns=len(waiting), timeout=_GRACE_S)
            self._ray.kill(self._board)

    def _ended(self) -> list[Any]:
        refs = list(self._running)
        done, _ = self._ray.wait(refs, num_returns=1, timeout=_POLL_S, fetch_local=False)
        if done:
            done, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0, fetch_local=False)
        return list(done)

    def _end(self, ref: Any, index: int) -> Finished[None, Any] | None:
        """Result of a task; None if its worker or its node died."""
        errors = self._ray.exceptions
        try:
            return self._ray.get(ref)
        except (errors.NodeDiedError, errors.ObjectLostError):
            self._nodes_lost[index] += 1
            return None
        except (errors.WorkerCrashedError, errors.OutOfMemoryError):
            self._nodes_lost[index] = 0
            return None
        except errors.RayError as err:
            return Finished(None, error=f"{type(err).__name__}: {err}".splitlines()[0], trace=str(err))

    def _tell(self) -> None:
        """Report the progress on the board."""
        now = time.monotonic()
        with suppress(self._ray.exceptions.RayError):  # the board may be lost: it is for display only
            if self._reading is not None and self._ray.wait([self._reading], timeout=0)[0]:
                reading, self._reading = self._reading, None
                in_work = set(self._running.values())
                for index, at in self._ray.get(reading).items():
                    if index in in_work:
                        self._watch(index, *at)
            if self._reading is None and now - self._read_at >= _LOOK_S:
                self._reading, self._read_at = self._board.read.remote(), now

    def _count(self) -> None:
        """Count the CPUs of the cluster; ConfigError if no node has had room for a task for a long time."""
        now = time.monotonic()
        if now - self._counted_at < min(_COUNT_S, _NO_NODE_S):
            return
        self._counted_at = now
        rooms = [n["Resources"] for n in self._ray.nodes() if n["Alive"]]
        self._cpus = max(1, sum(int(room.get("CPU", 0)) for room in rooms))
        if any(room.get("CPU", 0) >= 1 and room.get("memory", 0) >= self._memory for room in rooms):
            self._room_at = now
        elif now - self._room_at > _NO_NODE_S:
            needed = f"1 CPU and {self._memory >> 30} GiB of memory"
            raise ConfigError("environment", "RAY_ADDRESS", f"no node of the cluster has {needed} for a task")


class _Board:
    """Progress of tasks; keeps unread entries."""

    def __init__(self) -> None:
        self._news: dict[int, tuple[int, int, str]] = {}

    def write(self, index: int, done: int, total: int, what: str) -> None:
        self._news[index] = (done, total, what)

    def read(self) -> dict[int, tuple[int, int, str]]:
        news, self._news = self._news, {}
        return news


def _work(
    function: Callable[[Any, Progress], Any], item: Any, index: int, board: Any, version: str
) -> Finished[None, Any]:
    """A task; the driver has the item. It reports its progress every second, and when its stage changes."""
    if version != CODE_VERSION:
        problem = f"the driver is of version {version}: install the same on every node"
        raise ContractError(f"boresight {CODE_VERSION}", problem)
    said_at, said = 0.0, ""

    def progress(done: int, total: int, what: str) -> None:
        nonlocal said_at, said
        now, stage = time.monotonic(), what.partition(" ")[0]
        if stage != said or now - said_at >= _LOOK_S:
            said_at, said = now, stage
            with suppress(Exception):  # progress is optional
                board.write.remote(index, done, total, what)

    # Ray stops a task by SIGINT, which background processes of a shell and their children ignore.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    finished = attempt(function, item, progress)
    return Finished(None, finished.value, finished.error, finished.trace)
