"""Survey of logs: every topic with a few of its messages decoded."""

from __future__ import annotations

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

__all__ = ["Survey", "Topic", "survey_logs"]

_SAMPLES = 5  # messages of a topic decoded per log: an empty scan or a dark image may come first
# Length of the surveyed part. All sensors of a car log within a second; transforms are logged at the start.
_LONGEST_NS = 60 * 10**9
_KNOWN = {kind for kinds in ACCEPTED_TYPES.values() for kind in kinds}


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
    except (LogError, *DECODE_ERRORS) as err:
        problem = f"topic {topic.name}: {err}"
        if problem not in survey.problems:
            survey.problems.append(problem)
