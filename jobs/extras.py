"""What the extras of the distribution bring, and the one line that names the extra which a command lacks."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib.util import find_spec
from typing import ParamSpec, TypeVar

__all__ = ["EXTRAS", "needs", "require"]

P = ParamSpec("P")
R = TypeVar("R")

# Extra -> the module without which its commands, or an option of them, cannot start.
EXTRAS = {"simulate": "embreex", "train": "torch", "ray": "ray", "ops": "openlineage", "viz": "foxglove"}


def needs(extra: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Mark a command that cannot do anything without an extra."""

    def mark(command: Callable[P, R]) -> Callable[P, R]:
        @wraps(command)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            require(extra)
            return command(*args, **kwargs)

        return checked

    return mark


def require(extra: str) -> None:
    """Ask before any work is done, so that nothing is half-written and no worker process has to say it.

    Raises:
        MissingExtraError: the extra is not installed.
    """
    from pipeline.errors import MissingExtraError

    if find_spec(EXTRAS[extra]) is None:
        raise MissingExtraError(extra, EXTRAS[extra])
