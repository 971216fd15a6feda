"""Pages of vehicle-days, drawn by the executor of the night."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.core.results import Progress
from pipeline.fleet.executor import EXECUTORS

__all__ = ["OnWorkers"]

_FEW = 3  # for fewer items, starting a pool (about two seconds) takes longer than the work itself


@dataclass(frozen=True)
class OnWorkers:
    """Runs a function on many items by an executor; reports every item's outcome, success or error."""

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
