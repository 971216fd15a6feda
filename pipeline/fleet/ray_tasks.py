"""Items as plain tasks of a Ray cluster: the one in $RAY_ADDRESS, or a small one on this machine.

Ray runs every task in a process of its own, so a dead worker affects no other task. If a node is lost, its
tasks are tried again elsewhere, without blame. Needs the extra [ray]; see README.md in this folder.
"""

from __future__ import annotations

import logging
import os
import secrets
import signal
import socket
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import ModuleType
from typing import Any, TypeVar

from pipeline.core.errors import ConfigError, ContractError, MissingExtraError
from pipeline.core.memory import usable_cpus
from pipeline.core.results import Progress
from pipeline.fleet.processes import ONE_THREAD, Finished, Turns, Watch, attempt
from schemas.versions import CODE_VERSION

__all__ = ["run_on_ray"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

# Memory limit of a worker in DESIGN, for logs of any length (long_log.json of 62eb5928: 455 MB).
_MEMORY_BYTES = 2 << 30
# Vehicle-days and their records are kilobytes, a page is a megabyte; by default Ray takes 30 % of the memory.
_STORE_BYTES = 200 << 20
_ANSWER_S = 10.0  # a connection takes milliseconds
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
    ray, turns = _connected(workers or usable_cpus()), Turns(len(items))
    with _sigterm_between_calls() as obey:
        crew = _Crew(ray, function, items, watch)
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
        self, ray: ModuleType, function: Callable[[Any, Progress], Any], items: Sequence[Any], watch: Watch
    ) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy  # noqa: PLC0415 - an extra

        self._ray, self._items, self._watch = ray, items, watch
        is_shared = bool(os.environ.get("RAY_ADDRESS"))
        # on a single machine `workers` limits the memory
        self._memory = _MEMORY_BYTES if is_shared else 0
        # What tasks need for imports; a shared cluster must have the same installation.
        path = {} if is_shared else {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._function = self._ray.put(function)
        # The board is an actor on this node, and ends with the driver.
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._board = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
        self._reading, self._read_at = self._board.read.remote(), time.monotonic()
        self._task = self._ray.remote(_work).options(
            num_cpus=1,
            memory=self._memory or None,
            max_retries=0,  # Ray would retry a poisoned item beside the others
            runtime_env={"env_vars": path | ONE_THREAD},
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


def _connected(workers: int) -> ModuleType:
    """Connect to the cluster in $RAY_ADDRESS, else start one on this machine with `workers` CPUs.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: $RAY_ADDRESS cannot be reached, or is that of a Ray client.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage data leaves the cluster
    try:
        import ray  # noqa: PLC0415 - an extra
    except ImportError as err:
        raise MissingExtraError("ray", "ray") from err
    address = os.environ.get("RAY_ADDRESS", "")
    if "://" in address:
        problem = f"{address!r}: the night must run in the cluster (`ray job submit`), not as a client of it"
        raise ConfigError("environment", "RAY_ADDRESS", problem)
    if not ray.is_initialized():
        _require_answer(address)
        own = {"num_cpus": workers, "object_store_memory": _STORE_BYTES, "include_dashboard": False}
        if not address:
            # Otherwise Ray writes one into the home folder.
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex())
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        with _signals_stay():
            try:
                ray.init(address or "local", **quiet, **({} if address else own))
            except ConnectionError as err:
                raise ConfigError("environment", "RAY_ADDRESS", f"no cluster at {address!r}") from err
        # Ray would print dead workers to stdout, which is for the summary; the executor reports them.
        ray._private.worker.print_to_stdstream = lambda *_args, **_kwargs: None  # noqa: SLF001 - there is no other way
    return ray


def _require_answer(address: str) -> None:
    """Raise ConfigError if HOST:PORT does not answer: Ray itself would try for a quarter of an hour."""
    host, separator, port = address.rpartition(":")
    if not separator:  # no port, or "auto"
        return
    try:
        socket.create_connection((host, int(port)), _ANSWER_S).close()
    except (OSError, ValueError) as err:
        raise ConfigError("environment", "RAY_ADDRESS", f"no cluster at {address!r}: {err}") from err


@contextmanager
def _signals_stay() -> Iterator[None]:
    """Keep the process's SIGTERM handler: Ray's would end it with another exit code."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    except SystemExit:  # Ray's reaction to SIGTERM
        sys.exit(128 + signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _sigterm_between_calls() -> Iterator[Callable[[], None]]:
    """Defer SIGTERM to calls of the returned function: inside a call of Ray, every exit code becomes 1."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    noted: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda signum, _frame: noted.append(signum))

    def obey() -> None:
        if noted:
            noted.clear()
            signal.signal(signal.SIGTERM, before)
            signal.raise_signal(signal.SIGTERM)

    try:
        yield obey
        obey()
    finally:
        signal.signal(signal.SIGTERM, before)
