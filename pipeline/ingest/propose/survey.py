"""Survey of logs: every topic with a few of its messages decoded; and the pattern of their paths."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.errors import LogError
from pipeline.core.results import Progress, silent
from pipeline.ingest.containers.reader import LogReader, RawMessage, open_log
from pipeline.ingest.index import ACCEPTED_TYPES
from pipeline.ingest.messages.decoding import DECODE_ERRORS, decode, header_frame_id
from pipeline.rig.transform_tree import TransformTree

__all__ = ["Survey", "Topic", "logs_pattern", "nightly_command", "survey_logs"]

_SAMPLES = 5  # messages of a topic decoded per log: an empty scan or a dark image may come first
# Length of the surveyed part. All sensors of a car log within a second; transforms are logged at the start.
_LONGEST_NS = 60 * 10**9
_KNOWN = {kind for kinds in ACCEPTED_TYPES.values() for kind in kinds}
_SUFFIXES = {".mcap", ".bag", ".db3", ".zstd"}
_DAY = re.compile(r"\d{4}-?\d{2}-?\d{2}")


@dataclass(eq=False)
class Topic:
    """A topic of a type that Boresight reads, with the frame id of its last decoded message, else ""."""

    name: str
    msgtype: str
    messages: int = 0
    frame_id: str = ""
    samples: list[Any] = field(default_factory=list)

    def is_a(self, role: str) -> bool:
        """Whether its type fits a role: image, info, labels, detections, lidar, radar, odometry."""
        return self.msgtype in ACCEPTED_TYPES[role]


@dataclass(eq=False)
class Survey:
    """Content of the readable `logs`; `transforms` holds a tree for each topic of transforms."""

    topics: dict[str, Topic] = field(default_factory=dict)
    transforms: dict[str, TransformTree] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    logs: list[Path] = field(default_factory=list)

    def of(self, role: str) -> list[Topic]:
        """Topics whose type fits a role, sorted by name."""
        return [self.topics[name] for name in sorted(self.topics) if self.topics[name].is_a(role)]


def survey_logs(logs: Sequence[Path], progress: Progress = silent) -> Survey:
    """Read the first minute of each log."""
    survey = Survey()
    for done, path in enumerate(logs):
        progress(done, len(logs), f"looking through {path.name}")
        try:
            log = open_log(path)
        except LogError as err:
            survey.problems.append(str(err))
            continue
        survey.logs.append(path)
        try:
            _look_through(log, survey)
        finally:
            log.close()
    return survey


def _look_through(log: LogReader, survey: Survey) -> None:
    first_ns, taken = None, dict[str, int]()
    for message in log.scan():
        if message.channel.msgtype not in _KNOWN:
            continue
        first_ns = message.log_time_ns if first_ns is None else first_ns
        if message.log_time_ns > first_ns + _LONGEST_NS:
            break
        name = message.channel.topic
        topic = survey.topics.setdefault(name, Topic(name, message.channel.msgtype))
        topic.messages += 1
        if topic.is_a("tf_static") or taken.get(name, 0) < _SAMPLES:
            taken[name] = taken.get(name, 0) + 1
            _take(message, topic, survey)


def _take(message: RawMessage, topic: Topic, survey: Survey) -> None:
    try:
        # the data is a view of the log's chunk, so decode from a copy
        decoded = decode(message.channel, memoryview(bytes(message.data)))
        if topic.is_a("tf_static"):
            survey.transforms.setdefault(topic.name, TransformTree()).add_message(decoded)
            return
        topic.samples.append(decoded)
        topic.frame_id = header_frame_id(message.channel, message.data)
    except DECODE_ERRORS as err:
        problem = f"topic {topic.name}: {err}"
        if problem not in survey.problems:
            survey.problems.append(problem)


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
