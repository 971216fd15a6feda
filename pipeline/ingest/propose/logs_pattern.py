"""Path pattern of logs for the nightly command, derived from the paths of some logs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

__all__ = ["logs_pattern", "nightly_command"]

_SUFFIXES = {".mcap", ".bag", ".db3", ".zstd"}
_DAY = re.compile(r"\d{4}-?\d{2}-?\d{2}")


def logs_pattern(logs: Sequence[Path]) -> str:
    """Pattern for `boresight nightly --logs`; "" if the names contain no vehicle or day.

    Files that are not logs are ignored: a shell's `logs/*` includes them.
    """
    paths = [path for path in logs if path.is_dir() or path.suffix in _SUFFIXES]
    patterns = {_pattern(path) for path in paths}
    return patterns.pop() if len(patterns) == 1 else ""


def nightly_command(fleet: Path, logs: Sequence[Path]) -> list[str]:
    """Nightly command for these logs; before it, a step to move logs without vehicle or day in their path."""
    pattern = logs_pattern(logs)
    first = (
        [] if pattern else [f"move each log to logs/VEHICLE/DAY/, as logs/car-1/2026-05-31/{logs[0].name}"]
    )
    shown = pattern or "logs/{vehicle}/{day}/*"
    return [*first, f'boresight nightly --fleet {fleet} --lake lake --logs "{shown}"']


def _pattern(path: Path) -> str:
    """From folders VEHICLE/DAY, else from a file name VEHICLE_DAY...; it matches logs of every format."""
    parts = path.parts
    day = next((i for i, part in enumerate(parts[:-1]) if _DAY.fullmatch(part)), 0)
    if day:
        return str(Path(*parts[: day - 1], "{vehicle}", "{day}", *parts[day + 1 : -1], "*"))
    in_name = _DAY.search(path.name)
    vehicle = "" if in_name is None else path.name[: in_name.start()].rstrip("_-.")
    if in_name is None or not vehicle:
        return ""
    return str(path.parent / f"{{vehicle}}{path.name[len(vehicle) : in_name.start()]}{{day}}*")
