"""Optional dependencies (extras) of the distribution, and the error that names a missing one."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib.util import find_spec
from typing import ParamSpec, TypeVar

__all__ = ["EXTRAS", "needs", "require"]

P = ParamSpec("P")
R = TypeVar("R")

# Extra -> a module that commands with this extra import.
EXTRAS = {
    "simulate": "embreex",
    "train": "torch",
    "ray": "ray",
    "ops": "prometheus_client",
    "viz": "foxglove",
    "view": "open3d",
}


def needs(extra: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Mark a command that needs an extra."""

    def mark(command: Callable[P, R]) -> Callable[P, R]:
        @wraps(command)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            require(extra)
            return command(*args, **kwargs)

        return checked

    return mark


def require(extra: str) -> None:
    """Raise MissingExtraError before any work, so that no file is half-written."""
    from pipeline.core.errors import MissingExtraError

    if find_spec(EXTRAS[extra]) is None:
        raise MissingExtraError(extra, EXTRAS[extra])
