"""Progress of a night: bars on a terminal, otherwise a line per started stage and finished vehicle-day."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from jobs.terminal.logging import logger
from jobs.terminal.summary import LOG_EVERY_S, is_terminal
from pipeline.core.stages import STAGES
from pipeline.fleet.nightly import DayOutcome

__all__ = ["night_view"]

_MARKS = {
    "done": "[green]ok[/]",
    "cached": "[dim]up to date[/]",
    "partly": "[yellow]partly[/]",
    "held": "[yellow]held[/]",
    "refused": "[yellow]refused[/]",
    "failed": "[bold red]failed[/]",
}


@contextmanager
def night_view(names: list[str], total: int, title: str = "night") -> Iterator[_Lines | _Bars]:
    """A view of `total` vehicle-days; `names` are those in work, in order of index.

    Call `watch` with progress (by index), `finished` with the outcome of a vehicle-day, and `ended` with the name of
    other work that ended.
    """
    if not is_terminal():
        yield _Lines(names, total, title)
        return

    columns = (
        SpinnerColumn(),
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[what]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        yield _Bars(bars, names, total, title)


class _Lines:
    """Lines for a log file, updated five times a second: a shorter stage may get no line, a long one gets several."""

    def __init__(self, names: list[str], total: int, title: str) -> None:
        self._names, self._total, self._title, self._ended = names, total, title, 0
        self._stages = {stage.name for stage in STAGES}
        self._in_work: dict[int, str] = {}
        self._last = time.monotonic()  # of any line

    def watch(self, index: int, done: int, total: int, what: str) -> None:
        stage, (vehicle, _, day) = what.partition(" ")[0], self._names[index].rpartition(" ")
        if stage in self._stages and self._in_work.get(index) != stage:
            self._in_work[index] = stage
            self._last = time.monotonic()
            logger().info("stage", vehicle=vehicle, day=day, stage=stage)
        elif time.monotonic() - self._last >= LOG_EVERY_S:
            self._last = time.monotonic()
            logger().info("progress", vehicle=vehicle, day=day, what=what, done=done, total=total)

    def finished(self, outcome: DayOutcome) -> None:
        self._ended += 1
        log = logger().error if outcome.status == "failed" else logger().info
        trace = {"trace": outcome.trace} if outcome.trace else {}
        names = ("vehicle", "day", "status", "reason", "stages", "pairs", "frames")
        told = {name: getattr(outcome, name) for name in names}
        log("vehicle-day", **told, ended=self._ended, total=self._total, **trace)

    def ended(self, name: str) -> None:
        self._ended += 1
        logger().info(self._title, what=name, ended=self._ended, total=self._total)


class _Bars:
    def __init__(self, bars: Any, names: list[str], total: int, title: str) -> None:
        self._bars, self._names = bars, names
        self._all = bars.add_task(title, total=total, what="")
        self._tasks: dict[int, Any] = {}
        self._began: dict[str, float] = {}

    def watch(self, index: int, done: int, total: int, what: str) -> None:
        if index not in self._tasks:
            self._tasks[index] = self._bars.add_task(f"  {self._names[index]}", total=None, what="")
            self._began[self._names[index]] = time.monotonic()
        text = what.replace(self._names[index], "").strip()  # the name is already at the start of the line
        self._bars.update(self._tasks[index], completed=done, total=total or None, what=text)

    def finished(self, outcome: DayOutcome) -> None:
        name = f"{outcome.vehicle} {outcome.day}"
        self.ended(name)
        seconds = f"{time.monotonic() - self._began[name]:5.1f} s" if name in self._began else "      -"
        accepted = sum(s == "accepted" for s in outcome.pairs.values())
        pairs = f"{accepted}/{len(outcome.pairs)} pairs accepted" if outcome.pairs else ""
        why = f"[dim]{outcome.reason[:90]}[/]" if outcome.status not in ("done", "cached") else ""
        self._bars.print(f"{name}  {seconds}  {_MARKS[outcome.status]}  {pairs}  {why}", highlight=False)

    def ended(self, name: str) -> None:
        for index in [i for i in self._tasks if self._names[i] == name]:
            self._bars.remove_task(self._tasks.pop(index))
        self._bars.advance(self._all)
