"""Run one function on many vehicle-days: in this process, in a pool of processes, or on a Ray cluster.

A backend is a function in EXECUTORS; all yield one `Finished` per item, in order of completion, for every
outcome of the item. Only a request to stop (KeyboardInterrupt, SystemExit) ends them early, and then all
workers end too.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from pipeline.core.results import Progress
from pipeline.fleet.processes import Executor, Finished, Watch, attempt, run_processes
from pipeline.fleet.ray_tasks import run_on_ray

__all__ = ["EXECUTORS", "Finished", "OnWorkers", "Watch"]

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def _run_inline(
    function: Callable[[Item, Progress], Outcome], items: Sequence[Item], workers: int | None, watch: Watch
) -> Generator[Finished[Item, Outcome], None, None]:
    """Run one item after the other in this process; `workers` is ignored."""
    del workers
    for index, item in enumerate(items):
        yield attempt(function, item, lambda *at, i=index: watch(i, *at))


EXECUTORS: dict[str, Executor] = {"inline": _run_inline, "process": run_processes, "ray": run_on_ray}
_FEW = 3  # for fewer pages, starting a pool (about two seconds) takes longer than the work itself


@dataclass(frozen=True)
class OnWorkers:
    """Runs a function on many pages by an executor; reports every page's outcome, success or error."""

    executor: str
    workers: int | None

    def __call__(
        self, function: Callable[[Any, Progress], Any], items: Sequence[Any], progress: Progress
    ) -> Iterator[tuple[Any, Any, str]]:
        """Yield (item, value, error) in order of completion."""
        run = EXECUTORS["inline" if len(items) < _FEW else self.executor]
        for done, finished in enumerate(run(function, items, self.workers, lambda *_: None)):
            yield finished.item, finished.value, finished.error
            progress(done + 1, len(items), str(finished.item))
