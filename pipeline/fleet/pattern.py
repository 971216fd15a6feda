"""Which logs belong to which vehicle-day: "logs/{vehicle}/{day}/*.mcap" against what is there."""

from __future__ import annotations

import glob
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.store.partitions import Partition, is_day

__all__ = ["VehicleDay", "check_day", "find_vehicle_days"]

_SUFFIXES = (".mcap", ".bag", ".db3", ".zstd")
_GROUPS = {"{vehicle}": "vehicle", "{day}": "day"}
_GROUP_PATTERNS = {"vehicle": r"[^/=]+?", "day": r"\d{4}-\d{2}-\d{2}"}
_TOKEN = re.compile(r"\{[^{}]*\}|\*\*/|\*\*|\*|\?|\[[^\]]+\]|[^{*?\[]+|.")


@dataclass(frozen=True)
class VehicleDay:
    """One unit of work: the logs of a vehicle and a day, in order of path."""

    partition: Partition
    logs: tuple[Path, ...]


def find_vehicle_days(
    pattern: str, from_day: str | None = None, to_day: str | None = None
) -> list[VehicleDay]:
    """Vehicle-days of all logs that match, in order of day and vehicle, so that a night ends day by day.

    Args:
        pattern: a path with {vehicle} and {day} (YYYY-MM-DD), each as often as wanted, also inside file
            names; besides *, ?, [abc] and ** as in a shell. A match is an .mcap, .bag or .db3 file, a ROS 2
            bag folder, or a folder of such logs; other files are passed over.
        from_day: first day wanted, None = from the beginning.
        to_day: last day wanted.

    Raises:
        ConfigError: a placeholder is missing or unknown, a day is no day, or nothing at all matches.
    """
    for name, day in (("--from", from_day), ("--to", to_day)):
        check_day(name, day)
    if from_day and to_day and from_day > to_day:
        raise ConfigError("command line", "--from", f"{from_day} is after --to {to_day}")
    matcher = _matcher(pattern)
    shell = re.sub(r"\{(vehicle|day)\}", "*", pattern)
    found: dict[tuple[str, str], set[Path]] = defaultdict(set)
    for name in glob.iglob(shell, recursive=True, include_hidden=False):  # noqa: PTH207 - patterns may be absolute
        match = matcher.fullmatch(name.rstrip("/"))
        if match and is_day(match["day"]):
            found[match["day"], match["vehicle"]].update(_logs_at(Path(name)))
    days = [
        VehicleDay(Partition(vehicle, day), tuple(sorted(logs)))
        for (day, vehicle), logs in sorted(found.items())
        if logs
    ]
    if not days:
        raise ConfigError("command line", "--logs", f"no log matches {pattern!r}")
    return [d for d in days if (from_day or "") <= d.partition.day <= (to_day or "9999")]


def check_day(name: str, day: str | None) -> None:
    """Raise ConfigError, naming the option, where a day is given that is no YYYY-MM-DD."""
    if day is not None and not is_day(day):
        raise ConfigError("command line", name, f"{day!r} is no day of the form YYYY-MM-DD")


def _matcher(pattern: str) -> re.Pattern[str]:
    """The pattern as a regular expression; a placeholder that comes again must say the same."""
    seen: set[str] = set()
    parts = []
    for token in _TOKEN.findall(pattern.rstrip("/")):
        if token in _GROUPS:
            name = _GROUPS[token]
            parts.append(f"(?P={name})" if name in seen else f"(?P<{name}>{_GROUP_PATTERNS[name]})")
            seen.add(name)
        elif token.startswith("{"):
            raise ConfigError("command line", "--logs", f"unknown placeholder {token} in {pattern!r}")
        else:
            parts.append(_shell_token(token))
    for name in ("vehicle", "day"):
        if name not in seen:
            raise ConfigError("command line", "--logs", f"{pattern!r} lacks {{{name}}}")
    return re.compile("".join(parts))


def _shell_token(token: str) -> str:
    # The shell pattern has chosen the files already; here it only says where the placeholders stand.
    wildcards = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    return wildcards.get(token) or ("[^/]" if token[0] == "[" and len(token) > 1 else re.escape(token))


def _logs_at(path: Path) -> list[Path]:
    """The logs that a match stands for."""
    if path.is_dir():
        if _is_bag_folder(path):
            return [path]
        return sorted(p for p in path.iterdir() if _is_log(p) or (p.is_dir() and _is_bag_folder(p)))
    if not _is_log(path):
        return []
    return [path.parent] if _is_bag_folder(path.parent) else [path]


def _is_log(path: Path) -> bool:
    return path.is_file() and path.suffix in _SUFFIXES


def _is_bag_folder(path: Path) -> bool:
    """A ROS 2 recording: metadata beside its files, or database files whose metadata was lost."""
    return (path / "metadata.yaml").is_file() or any(path.glob("*.db3"))
