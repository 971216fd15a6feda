"""Optional dependencies (extras) of the distribution, and the error that names a missing one."""

from __future__ import annotations

from importlib.util import find_spec

__all__ = ["require"]

# Extra -> a module that commands with this extra import.
_EXTRAS = {
    "simulate": "embreex",
    "train": "torch",
    "ray": "ray",
    "ops": "prometheus_client",
    "viz": "foxglove",
    "view": "open3d",
}


def require(extra: str) -> None:
    """Raise MissingExtraError before any work, so that no file is half-written."""
    from pipeline.core.errors import MissingExtraError

    if find_spec(_EXTRAS[extra]) is None:
        raise MissingExtraError(extra, _EXTRAS[extra])
