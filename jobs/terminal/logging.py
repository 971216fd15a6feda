"""Logs on stderr: JSON lines for machines, short coloured lines on a terminal."""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["configure", "logger"]


def configure() -> None:
    """Configure structlog for this process; called once by the command line and once in every worker."""
    import structlog

    shared: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    if sys.stderr.isatty():
        shared.append(structlog.dev.ConsoleRenderer())
    else:
        shared += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(default=str)]
    structlog.configure(
        processors=shared,
        wrapper_class=structlog.make_filtering_bound_logger("info"),
        logger_factory=_stderr,
        cache_logger_on_first_use=False,
    )


def logger() -> Any:
    """The process's structured logger: `logger().info("event", vehicle=..., day=...)`."""
    import structlog

    if not structlog.is_configured():
        configure()
    return structlog.get_logger()


def _stderr(*_args: Any) -> Any:
    """A logger on the current stderr, so that redirection and rich's live display both get the lines."""
    import structlog

    return structlog.WriteLogger(sys.stderr)
