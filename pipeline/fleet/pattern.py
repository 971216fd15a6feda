"""Which logs belong to which vehicle-day: "logs/{vehicle}/{day}/*.mcap" against what is there.

Paths are strings here: a fleet's night looks at a hundred thousand of them.
"""

# ruff: noqa: PTH116, PTH118, PTH120, PTH207

from __future__ import annotations

import glob
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.store.partitions import Partition, check_day, is_day
from pipeline.store.remote_logs import LogPath, find_remote_logs

__all__ = ["VehicleDay", "find_vehicle_days"]

_SUFFIXES = (".mcap", ".bag", ".db3", ".zstd")
_ROS2_FILES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")  # as `ingest` reads them from a folder
_Owner = tuple[str, str]  # day, vehicle
_GROUPS = {"{vehicle}": "vehicle", "{day}": "day"}
_GROUP_PATTERNS = {"vehicle": r"[^/=]+?", "day": r"\d{4}-\d{2}-\d{2}|\d{8}"}
_TOKEN = re.compile(r"\{[^{}]*\}|\*\*/|\*\*|\*|\?|\[[^\]]+\]|[^{*?\[]+|.")


@dataclass(frozen=True)
class VehicleDay:
    """One unit of work: the logs of a vehicle and a day, in order of path."""

    partition: Partition
    logs: tuple[LogPath, ...]


def find_vehicle_days(
    pattern: str, from_day: str | None = None, to_day: str | None = None
) -> list[VehicleDay]:
    """Vehicle-days of all logs that match, in order of day and vehicle, so that a night ends day by day.

    Args:
        pattern: a path with {vehicle} and {day} (YYYY-MM-DD or YYYYMMDD), each as often as wanted, also inside file
            names; besides *, ?, [abc] and ** as in a shell. A match is an .mcap, .bag or .db3 file, a ROS 2
            bag folder, or a folder of such logs; other files are passed over. Of a bucket
            ("s3://BUCKET/{vehicle}/{day}/*.mcap") each object that matches is a log. A bag folder is one log where all
            of its files match for the same vehicle-day; in a folder that vehicles or days share, each file is.
        from_day: first day wanted, None = from the beginning.
        to_day: last day wanted.

    Raises:
        ConfigError: a placeholder is missing or unknown, a day is no day, or nothing at all matches.
    """
    for name, day in (("--from", from_day), ("--to", to_day)):
        check_day(name, day)
    if from_day and to_day and from_day > to_day:
        raise ConfigError("command line", "--from", f"{from_day} is after --to {to_day}")
    days = [
        VehicleDay(Partition(vehicle, day), tuple(sorted(logs)))
        for (day, vehicle), logs in sorted(_found(pattern).items())
    ]
    if not days:
        raise ConfigError("command line", "--logs", f"no log matches {pattern!r}")
    return [d for d in days if (from_day or "") <= d.partition.day <= (to_day or "9999")]


def _found(pattern: str) -> Mapping[_Owner, Iterable[LogPath]]:
    """Logs of each vehicle-day that matches, in a folder or in a bucket."""
    if not pattern.startswith("s3://"):
        return _logs_by_owner(_owned(pattern))
    matcher, found = _matcher(pattern), defaultdict[_Owner, list[LogPath]](list)
    # Listed is what lies below the last folder that the pattern names to the letter.
    for log in find_remote_logs(re.split(r"[{*?\[]", pattern)[0].rpartition("/")[0]):
        match = matcher.fullmatch(str(log))
        if match and is_day(_day(match)) and log.name.endswith(_SUFFIXES):
            found[_day(match), match["vehicle"]].append(log)
    return found


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


def _day(match: re.Match[str]) -> str:
    """As YYYY-MM-DD; loggers also write YYYYMMDD."""
    day = match["day"]
    return day if "-" in day else f"{day[:4]}-{day[4:6]}-{day[6:]}"


def _shell_token(token: str) -> str:
    wildcards = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    if token[0] != "[" or len(token) == 1:
        return wildcards.get(token) or re.escape(token)
    negation = "^" if token[1] == "!" else ""
    return f"[{negation}{re.escape(token[1 + len(negation) : -1]).replace(chr(92) + '-', '-')}]"


def _owned(pattern: str) -> dict[str, _Owner]:
    """Whose each log file and bag folder is that matches, or that lies in a folder that does.

    Folders are listed once each, so the work grows with the number of files. What a link leads to a second time within
    a vehicle-day is passed over: a link to its own parent would show every log forty times. Linked into two
    vehicle-days it is a log of both, as a copy would be.
    """
    matcher, listings = _matcher(pattern), _Listings()
    shell = re.sub(r"\{(vehicle|day)\}", "*", pattern)
    owner: dict[str, _Owner] = {}
    seen: dict[tuple[_Owner, int, int], str] = {}
    for name in sorted(glob.iglob(shell, recursive=True, include_hidden=False)):
        path = name.rstrip("/")
        match = matcher.fullmatch(path)
        if not match or not is_day(_day(match)):
            continue
        for log in listings.logs_at(path):
            about, own = os.stat(log), (_day(match), match["vehicle"])
            if seen.setdefault((own, about.st_dev, about.st_ino), log) == log:
                owner[log] = own
    return owner


def _logs_by_owner(owner: dict[str, _Owner]) -> dict[_Owner, set[Path]]:
    """Logs of each vehicle-day: a recording's folder as one where all of its files are that vehicle-day's."""
    folders: dict[str, list[str]] = defaultdict(list)
    for log in owner:
        folders[os.path.dirname(log)].append(log)
    listings = _Listings()
    found: dict[_Owner, set[Path]] = defaultdict(set)
    for folder, logs in folders.items():
        files = listings.bag_files(folder)
        together = bool(files) and files <= set(logs) and len({owner[f] for f in files}) == 1
        for log in logs:
            found[owner[log]].add(Path(folder if together and log in files else log))
    return found


class _Listings:
    """What lies in folders, each listed once."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[dict[str, None], list[str]]] = {}

    def logs_at(self, path: str) -> list[str]:
        """The log files that a match stands for: itself, or those in it and in the recordings in it."""
        if path.endswith(_SUFFIXES) and path in self._listed(os.path.dirname(path))[0]:
            return [path]
        files, folders = self._listed(path)
        if os.path.join(path, "metadata.yaml") in files and not self.bag_files(path):
            return [path]  # a recording that lost its files: `ingest` says so
        logs = [f for f in files if f.endswith(_SUFFIXES)]
        return logs + [f for inner in folders for f in sorted(self.bag_files(inner))]

    def bag_files(self, folder: str) -> set[str]:
        """Files that ROS 2's recorder wrote into a folder: with its metadata, or databases that lost theirs."""
        files, _ = self._listed(folder)
        recorded = {f for f in files if f.endswith(_ROS2_FILES)}
        is_recording = os.path.join(folder, "metadata.yaml") in files or any(
            f.endswith(".db3") for f in recorded
        )
        return recorded if is_recording else set()

    def _listed(self, folder: str) -> tuple[dict[str, None], list[str]]:
        """Regular files and folders, by name; both empty for what is no folder that can be read."""
        if folder not in self._of:
            try:
                with os.scandir(folder or ".") as entries:
                    inside = sorted(entries, key=lambda e: e.name)
            except OSError:
                inside = []
            start = os.path.join(folder, "")
            files = dict.fromkeys(start + e.name for e in inside if _is(e.is_file))
            self._of[folder] = (files, [start + e.name for e in inside if _is(e.is_dir)])
        return self._of[folder]


def _is(kind: Callable[[], bool]) -> bool:
    """What an entry says of itself; no for a link that leads nowhere or round in a circle."""
    try:
        return kind()
    except OSError:
        return False
