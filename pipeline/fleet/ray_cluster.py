"""Connection to the Ray cluster of the tasks, without Ray's output and side effects."""

from __future__ import annotations

import logging
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from pipeline.core.errors import ConfigError, MissingExtraError

__all__ = ["Cluster", "connected", "sigterm_between_calls"]

# Vehicle-days and their records are kilobytes, a page is a megabyte; by default Ray takes 30 % of the memory.
_STORE_BYTES = 200 << 20
_ANSWER_S = 10.0  # a connection takes milliseconds


@dataclass(frozen=True)
class Cluster:
    """A connected cluster; `is_shared` if it is the one in $RAY_ADDRESS."""

    ray: ModuleType
    is_shared: bool

    @property
    def environment(self) -> dict[str, str]:
        """Environment that tasks need for imports; a shared cluster must have the same installation."""
        return {} if self.is_shared else {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}

    def beside_the_driver(self, kind: type[Any]) -> Any:
        """An actor on this node, which ends with its creator."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy  # noqa: PLC0415 - an extra

        here = self.ray.get_runtime_context().get_node_id()
        place = NodeAffinitySchedulingStrategy(here, soft=True)
        return self.ray.remote(kind).options(num_cpus=0, scheduling_strategy=place).remote()


def connected(workers: int) -> Cluster:
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
            os.environ.setdefault(
                "RAY_AUTH_TOKEN", secrets.token_hex()
            )  # else Ray writes one into the home folder
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        with _signals_stay():
            try:
                ray.init(address or "local", **quiet, **({} if address else own))
            except ConnectionError as err:
                raise ConfigError("environment", "RAY_ADDRESS", f"no cluster at {address!r}") from err
        # Ray would print dead workers to stdout, which is for the summary; the executor reports them.
        ray._private.worker.print_to_stdstream = _say_nothing  # noqa: SLF001 - there is no other way
    return Cluster(ray, bool(address))


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
def sigterm_between_calls() -> Iterator[Callable[[], None]]:
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


def _say_nothing(*_args: Any, **_kwargs: Any) -> None:
    """Replaces Ray's printing."""
