"""Assignment of logs to vehicle-days by a pattern such as "logs/{vehicle}/{day}/*".

Paths are strings here for speed: a fleet's night checks a hundred thousand of them.
"""

# ruff: noqa: PTH110, PTH116, PTH118, PTH120, PTH207

from __future__ import annotations

import glob
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Partition, check_day, is_day
from pipeline.store.remote_logs import LogPath, find_remote_logs

__all__ = ["VehicleDay", "find_logs", "find_vehicle_days"]

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
    """Vehicle-days of all logs that match, as `find_logs`."""
    return find_logs(pattern, from_day, to_day)[0]


def find_logs(
    pattern: str, from_day: str | None = None, to_day: str | None = None
) -> tuple[list[VehicleDay], str]:
    """Vehicle-days of all logs that match, in order of day and vehicle, so that a night finishes day by day.

    The second value names logs that the pattern leaves out for their format, and the pattern to use; empty
    if there are none.

    Args:
        pattern: a path with {vehicle} and {day} (YYYY-MM-DD or YYYYMMDD), each at least once, also inside
            file names; also *, ?, [abc] and ** as in a shell. A match is an .mcap, .bag or .db3 file, a ROS 2
            bag folder, or a folder of such logs; other files are ignored. In a bucket
            ("s3://BUCKET/{vehicle}/{day}/*.mcap") each matching object is a log. A bag folder is one log if
            all of its files match for the same vehicle-day; in a folder shared by vehicles or days, each file
            is a log.

    Raises:
        ConfigError: a placeholder is missing or unknown, a day is invalid, or nothing matches.
    """
    for name, day in (("--from", from_day), ("--to", to_day)):
        check_day(name, day)
    if from_day and to_day and from_day > to_day:
        raise ConfigError("command line", "--from", f"{from_day} is after --to {to_day}")
    wanted, others = (_vehicle_days(logs) for logs in _found(pattern))
    if not wanted:
        problem = _left_out(others, pattern) or f"no log matches {pattern!r}"
        raise ConfigError("command line", "--logs", problem)
    within, beside = (
        [d for d in days if (from_day or "") <= d.partition.day <= (to_day or "9999")]
        for days in (wanted, others)
    )
    return within, _left_out(beside, pattern)


def _left_out(days: Sequence[VehicleDay], pattern: str) -> str:
    if not days:
        return ""
    count = sum(len(day.logs) for day in days)
    few = f"{count} log{'s' * (count != 1)} of {len(days)} vehicle-day{'s' * (len(days) != 1)}"
    beside = f"in another format, as {days[0].logs[0]}"
    return f'--logs leaves out {few} {beside}: use --logs "{_wider(pattern)}"'


def _vehicle_days(logs: Mapping[_Owner, Iterable[LogPath]]) -> list[VehicleDay]:
    return [
        VehicleDay(Partition(vehicle, day), tuple(sorted(own)))
        for (day, vehicle), own in sorted(logs.items())
    ]


def _suffix(pattern: str) -> str:
    """Format that the pattern demands of logs; empty if it takes any."""
    return next((suffix for suffix in _SUFFIXES if pattern.endswith(suffix)), "")


def _wider(pattern: str) -> str:
    """The pattern for logs of any format."""
    stem = pattern.removesuffix(_suffix(pattern))
    # after {vehicle} a star would take all but the first letter of the name
    return stem if stem.endswith("*") else f"{stem}.*" if stem.endswith("{vehicle}") else f"{stem}*"


def _in_other_formats(pattern: str) -> list[re.Pattern[str]]:
    """Matchers of logs that differ from the pattern by their format; bag folders have no suffix."""
    own = _suffix(pattern)
    stem = pattern.removesuffix(own)
    return [_matcher(stem + other) for other in (*_SUFFIXES, "") if own and other != own]


_Found = tuple[Mapping[_Owner, Iterable[LogPath]], Mapping[_Owner, Iterable[LogPath]]]


def _found(pattern: str) -> _Found:
    """Logs of each matching vehicle-day, in a folder or in a bucket; and those in other formats."""
    if not pattern.startswith("s3://"):
        wanted, others = _owned(pattern)
        return _logs_by_owner(wanted), _logs_by_owner(others)
    matchers = [_matcher(pattern), *_in_other_formats(pattern)]
    found = defaultdict[_Owner, list[LogPath]](list), defaultdict[_Owner, list[LogPath]](list)
    # List everything below the last folder that the pattern names without wildcards.
    for log in find_remote_logs(re.split(r"[{*?\[]", pattern)[0].rpartition("/")[0]):
        for k, matcher in enumerate(matchers if log.name.endswith(_SUFFIXES) else ()):
            match = matcher.fullmatch(str(log))
            if match and is_day(_day(match)):
                found[min(k, 1)][_day(match), match["vehicle"]].append(log)
                break
    return found


def _matcher(pattern: str) -> re.Pattern[str]:
    """The pattern as a regular expression; a repeated placeholder must match the same text."""
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
    """Day of a match as YYYY-MM-DD; loggers also write YYYYMMDD."""
    day = match["day"]
    return day if "-" in day else f"{day[:4]}-{day[4:6]}-{day[6:]}"


def _shell_token(token: str) -> str:
    wildcards = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    if token[0] != "[" or len(token) == 1:
        return wildcards.get(token) or re.escape(token)
    negation = "^" if token[1] == "!" else ""
    return f"[{negation}{re.escape(token[1 + len(negation) : -1]).replace(chr(92) + '-', '-')}]"


def _owned(pattern: str) -> tuple[dict[str, _Owner], dict[str, _Owner]]:
    """Vehicle-day of each log file and bag folder that matches, or that is in a matching folder.

    Then the vehicle-days of logs that differ from the pattern by their format alone.

    Folders are listed once each, so the work grows with the number of files. A symbolic link to a log that
    was already found in the same vehicle-day is ignored: a link to its own parent would repeat every log
    forty times. A log linked into two vehicle-days belongs to both, as a copy would.
    """
    matchers, listings = [_matcher(pattern), *_in_other_formats(pattern)], _Listings()
    shell = re.sub(r"\{(vehicle|day)\}", "*", _any_format(pattern))
    owner: tuple[dict[str, _Owner], dict[str, _Owner]] = ({}, {})
    seen: dict[tuple[_Owner, int, int], str] = {}
    found = [(name.rstrip("/"), _first(matchers, name.rstrip("/"))) for name in sorted(
        glob.iglob(shell, recursive=True, include_hidden=False))]  # fmt: skip
    for path, (k, match) in sorted(found, key=lambda f: min(f[1][0], 1)):  # those that match come first
        if match is None or not is_day(_day(match)):
            continue
        for log in listings.logs_at(path) if k == 0 else listings.log_at(path):
            about, own = _about(log), (_day(match), match["vehicle"])
            if seen.setdefault((own, about.st_dev, about.st_ino), log) == log:
                owner[min(k, 1)][log] = own
    return owner[0], {log: own for log, own in owner[1].items() if log not in owner[0]}


def _any_format(pattern: str) -> str:
    """The pattern with any ending in place of that of a format."""
    own = _suffix(pattern)
    return f"{pattern.removesuffix(own).rstrip('*')}*" if own else pattern


def _first(matchers: Sequence[re.Pattern[str]], path: str) -> tuple[int, re.Match[str] | None]:
    """The first match, and the number of its matcher."""
    found = ((k, match) for k, matcher in enumerate(matchers) if (match := matcher.fullmatch(path)))
    return next(found, (0, None))


def _logs_by_owner(owner: dict[str, _Owner]) -> dict[_Owner, set[Path]]:
    """Logs of each vehicle-day; a folder is one log if all of its files are of that vehicle-day."""
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
    """Contents of folders, each listed once."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[dict[str, None], list[str]]] = {}

    def logs_at(self, path: str) -> list[str]:
        """Log files of a match: the match itself, or the logs and recordings in it."""
        if path.endswith(_SUFFIXES) and path in self._listed(os.path.dirname(path))[0]:
            return [path]
        files, folders = self._listed(path)
        if os.path.join(path, "metadata.yaml") in files and not self.bag_files(path):
            return [path]  # a recording that lost its files, which `ingest` reports
        logs = [f for f in files if f.endswith(_SUFFIXES)]
        return logs + [f for inner in folders for f in sorted(self.bag_files(inner))]

    def log_at(self, path: str) -> list[str]:
        """A log file, or the files of a recording; of another folder none."""
        return self.logs_at(path) if path.endswith(_SUFFIXES) else sorted(self.bag_files(path))

    def bag_files(self, folder: str) -> set[str]:
        """Files of a ROS 2 recording in a folder: with its metadata, or databases without metadata."""
        files, _ = self._listed(folder)
        recorded = {f for f in files if f.endswith(_ROS2_FILES)}
        is_recording = os.path.join(folder, "metadata.yaml") in files or any(
            f.endswith(".db3") for f in recorded
        )
        return recorded if is_recording else set()

    def _listed(self, folder: str) -> tuple[dict[str, None], list[str]]:
        """Regular files, links to lost logs, and folders, by name; both empty if it is not a readable folder."""
        if folder not in self._of:
            try:
                with os.scandir(folder or ".") as entries:
                    inside = sorted(entries, key=lambda e: e.name)
            except OSError:
                inside = []
            start = os.path.join(folder, "")
            files = dict.fromkeys(start + e.name for e in inside if _is(e.is_file) or _is_lost_log(e))
            self._of[folder] = (files, [start + e.name for e in inside if _is(e.is_dir)])
        return self._of[folder]


def _is(kind: Callable[[], bool]) -> bool:
    """Type check of a directory entry; False for a broken or circular link."""
    try:
        return kind()
    except OSError:
        return False


def _is_lost_log(entry: os.DirEntry[str]) -> bool:
    """Whether it is a link named like a log whose target is not there: a log that `ingest` reports as unreadable."""
    return entry.name.endswith(_SUFFIXES) and entry.is_symlink() and not os.path.exists(entry.path)


def _about(log: str) -> os.stat_result:
    """What a log is on the disk, or what its link is where that leads nowhere."""
    try:
        return os.stat(log)
    except OSError:
        return os.lstat(log)
