"""What of a night can be killed on each executor, and when nothing of a killed night is at work any more."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from tests.makers.ray_clusters import another_node, two_nodes

__all__ = ["CROWDS", "Crowd"]

_GONE_S = 30.0  # a worker sees within seconds that its night is gone
# What Ray calls a worker that has a task of `pipeline/fleet/ray_tasks.py`; and one that has none, or begins with it.
_TASK, _IDLE = "ray::_work", "ray::IDLE"


@dataclass(frozen=True)
class Crowd:
    """The processes that nights of one executor consist of, beside the night's own.

    Args:
        executor: as of `boresight nightly`.
        workers: that can be killed, by the night's process id.
        at_work: those of them that work for the night.
        kill_node: end a machine with all that runs on it and bring another; None where there are no machines.
    """

    executor: str
    workers: Callable[[int], list[psutil.Process]]
    at_work: Callable[[int], list[psutil.Process]]
    kill_node: Callable[[int], None] | None = None

    def kill_all(self, night: subprocess.Popen[str]) -> None:
        """The night and all of its workers, at the same moment."""
        workers = self.workers(night.pid)
        night.kill()
        for worker in workers:
            with suppress(psutil.NoSuchProcess):
                worker.kill()

    def wait_until_gone(self, night: subprocess.Popen[str]) -> None:
        """Wait until no worker of a killed night is left: they notice by themselves that it is gone."""
        if night.poll() is None:
            night.kill()
        night.communicate()
        deadline = time.monotonic() + _GONE_S
        while self.at_work(night.pid):
            if time.monotonic() > deadline:
                raise RuntimeError(f"workers of a killed night are still there after {_GONE_S:g} s")
            time.sleep(0.05)


@contextmanager
def _pool(_folder: Path) -> Iterator[Crowd]:
    """Spawned processes, in the night's own session."""
    yield Crowd("process", *[lambda night: _of_session(night, "spawn_main")] * 2)


@contextmanager
def _own_cluster(_folder: Path) -> Iterator[Crowd]:
    """Ray as a night starts it for itself. Its agents are not at work: they try to tell a dead cluster of its end."""
    yield Crowd(
        "ray", lambda night: _of_session(night, _TASK, _IDLE), lambda night: _of_session(night, _TASK)
    )


@contextmanager
def _shared_cluster(folder: Path) -> Iterator[Crowd]:
    """A cluster of two nodes that outlives nights; a lost node is followed by another one."""
    with (
        tempfile.TemporaryDirectory(prefix="ray-") as place,
        _environment(TMPDIR=str(folder), RAY_TMPDIR=place),
        two_nodes() as (cluster, nodes),
    ):

        def kill_node(which: int) -> None:
            cluster.remove_node(nodes.pop(which % len(nodes)), allow_graceful=False)
            nodes.append(another_node(cluster))

        yield Crowd("ray", lambda _: _of_this(_TASK, _IDLE), lambda _: _of_this(_TASK), kill_node)


# Ways to run nights, by what a result's line calls them.
CROWDS = {"process": _pool, "ray": _shared_cluster, "ray-own": _own_cluster}


@contextmanager
def _environment(**changes: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _of_this(*what: str) -> list[psutil.Process]:
    """Processes below this one whose command names what they do."""
    return [p for p in psutil.Process().children(recursive=True) if _does(p, what)]


def _of_session(night: int, *what: str) -> list[psutil.Process]:
    """Processes of a night's session whose command names what they do."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == night and _does(process, what):
                found.append(process)
    return found


def _does(process: psutil.Process, what: Sequence[str]) -> bool:
    command = " ".join(_command(process))
    return any(name in command for name in what)


def _command(process: psutil.Process) -> Sequence[str]:
    with suppress(psutil.Error):
        return process.cmdline()
    return []
