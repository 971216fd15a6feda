"""Run one function on many vehicle-days: in this process, in a pool of processes, or on a Ray cluster.

A backend is a function in EXECUTORS; all yield one `Finished` per item, in order of completion, for every
outcome of the item. Only a request to stop (KeyboardInterrupt, SystemExit) ends them early, and then all
workers end too.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

from pipeline.core.results import Progress
from pipeline.fleet.processes import Executor, Finished, Watch, attempt, run_processes, usable_cpus
from pipeline.fleet.ray_tasks import run_on_ray

__all__ = ["EXECUTORS", "Executor", "Finished", "Watch", "run_inline", "usable_cpus"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def run_inline(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int | None, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """Run one item after the other in this process; `workers` is ignored."""
    del workers
    for index, item in enumerate(items):
        yield attempt(function, item, lambda *at, i=index: watch(i, *at))


EXECUTORS: dict[str, Executor] = {"inline": run_inline, "process": run_processes, "ray": run_on_ray}
