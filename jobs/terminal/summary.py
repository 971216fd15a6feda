"""The end of every command: a JSON line on stdout and an exit code; and progress on stderr."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pipeline.core.results import Progress, plain

if TYPE_CHECKING:
    from pipeline.store.partitions import Lake

__all__ = [
    "LOG_EVERY_S",
    "exit_code",
    "is_terminal",
    "left_out",
    "print_json",
    "print_summary",
    "problems_of",
    "progress_reporter",
]

LOG_EVERY_S = 5.0  # without a terminal: often enough for a watchdog, rare enough for a log store


def print_summary(command: str, status: str, **fields: Any) -> None:
    """Print the last line of stdout, `{"command": ..., "status": ..., ...}`; nan and inf become null."""
    sys.stderr.flush()
    print_json({"command": command, "status": status} | fields)


def print_json(value: Any, *, indent: int | None = None) -> None:
    """Print strict JSON (numpy values and paths included) on stdout, on one line unless indented."""
    sys.stdout.write(json.dumps(plain(value), indent=indent, allow_nan=False) + "\n")
    sys.stdout.flush()


def exit_code(statuses: Iterable[str]) -> int:
    """Exit code of a command from the statuses of its results.

    1 if one is "failed" (a retry may help), else 2 if one is "misconfigured" (a person must correct it), else
    3 if one is "partly" accepted, "held", "refused" or "incomplete" (unreadable rows are left out), else 0.
    """
    seen = set(statuses)
    if seen & {"failed", "misconfigured"}:
        return 1 if "failed" in seen else 2
    return 3 if seen & {"partly", "held", "refused", "incomplete"} else 0


def problems_of(results: Iterable[Any], *names: str) -> list[dict[str, Any]]:
    """The named fields of each result that is neither done nor up to date."""
    return [{n: getattr(r, n) for n in names} for r in results if r.status not in ("done", "cached")]


def left_out(lake: Lake) -> list[str]:
    """Unreadable parts of a lake, each with its reason; logs a warning for each on stderr, once."""
    from jobs.terminal.logging import logger

    found = sorted(set(lake.damage))
    for what in found:
        logger().warning("left out, damaged", what=what)
    return found


def is_terminal() -> bool:
    """True if stderr is a terminal."""
    return sys.stderr.isatty()


@contextmanager
def progress_reporter(title: str) -> Iterator[Progress]:
    """A `Progress` for a stage: a bar on a terminal, otherwise a log line every few seconds, if it reports or not."""
    with _bar(title) if is_terminal() else _lines(title) as report:
        yield report


@contextmanager
def _bar(title: str) -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (
        SpinnerColumn(),
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TextColumn("[dim]{task.fields[what]}"),
        TimeElapsedColumn(),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(title, total=None, what="")

        def report(done: int, total: int, what: str) -> None:
            bars.update(task, completed=done, total=total or None, what=what)

        yield report


@contextmanager
def _lines(title: str) -> Iterator[Progress]:
    """Log from a thread, because the steps of some stages take longer than the time between two lines."""
    from jobs.terminal.logging import logger

    at: dict[str, Any] = {"done": 0, "total": 0, "what": ""}
    ended, began = threading.Event(), time.monotonic()

    def report(done: int, total: int, what: str) -> None:
        at.update(done=done, total=total, what=what)

    def log() -> None:
        while not ended.wait(LOG_EVERY_S):
            logger().info("progress", job=title, **at, seconds=round(time.monotonic() - began))

    thread = threading.Thread(target=log, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        ended.set()
        thread.join()
