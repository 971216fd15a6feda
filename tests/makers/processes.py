"""Processes that tests start and look at."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import psutil


@contextmanager
def started(command: list[str], **options: object) -> Iterator[subprocess.Popen]:
    """A process that ends with the block: one that a failed test left running would fail the next test too."""
    with subprocess.Popen(command, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def works(process: psutil.Process, what: str) -> bool:
    """Whether a process is at work and its name or arguments say so; any process listed may have ended since."""
    try:
        return what in " ".join([process.name(), *process.cmdline()])
    except psutil.NoSuchProcess:  # a zombie too
        return False


def descendants(process: subprocess.Popen) -> list[psutil.Process]:
    """The processes below one, none where it has ended."""
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
