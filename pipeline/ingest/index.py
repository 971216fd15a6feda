"""First pass over a day's logs: position and time of each message, and the small messages that frames need.

For a day longer than requested, only the stretches of a reading plan are read (`reading_plan.py`).
"""

from __future__ import annotations

import resource
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Int64

from pipeline.core.errors import LogError
from pipeline.ingest.containers.reader import Channel, ChunkCache, LogReader, Position, RawMessage, open_log
from pipeline.ingest.containers.timeline import Stretches, Timeline
from pipeline.ingest.messages.decoding import (
    DECODE_ERRORS,
    REFUSED,
    content_without_stamp,
    decode,
    encoding_fault,
    foxglove_types,
    header_frame_id,
    header_stamp_ns,
)
from pipeline.ingest.messages.detections import DETECTIONS_3D
from pipeline.ingest.messages.image import read_camera_info
from pipeline.ingest.messages.odometry import EgoTrack
from pipeline.ingest.reading_plan import Reading, plan_reading, plan_sweeps, rare_topics
from pipeline.ingest.reasons import because
from pipeline.ingest.roles import CAPTURED, INFO, ODOMETRY, TF_STATIC, Role, topics_of
from pipeline.rig.cameras import Camera
from pipeline.rig.rig import Rig
from pipeline.rig.transform_tree import TransformTree
from pipeline.store.remote_logs import LogPath

__all__ = ["ACCEPTED_TYPES", "DayIndex", "Located", "Stream", "index_logs"]

_IMAGE_TYPES = (
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    *foxglove_types("CompressedImage", "RawImage"),
)
_VIDEO_TYPES = foxglove_types("CompressedVideo")
_CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", *foxglove_types("PointCloud"))
ACCEPTED_TYPES: dict[str, tuple[str, ...]] = {
    "image": (*_IMAGE_TYPES, *_VIDEO_TYPES),
    "info": ("sensor_msgs/msg/CameraInfo", *foxglove_types("CameraCalibration")),
    "labels": _IMAGE_TYPES,
    "detections": ("vision_msgs/msg/Detection2DArray", *DETECTIONS_3D),
    "lidar": _CLOUD_TYPES,
    "radar": (*_CLOUD_TYPES, "radar_msgs/msg/RadarScan", "radar_msgs/msg/RadarTracks"),
    "odometry": ("nav_msgs/msg/Odometry", *foxglove_types("Odometry")),
    "tf_static": (
        "tf2_msgs/msg/TFMessage",
        "tf/msg/tfMessage",
        *foxglove_types("FrameTransforms", "FrameTransform"),
    ),
}
# A glance at logs for topics that the rig does not name: all sensors of a car log within a second.
_GLANCES, _GLANCE_NS = 3, 10**9
_MOST_OPEN_FILES = 65536  # one per minute of 45 days, more than a vehicle-day has
_MOST_CAMERAS = 1000  # distinct camera_info contents kept: a limit for drivers that write noise into them


@dataclass(frozen=True, slots=True)
class Located:
    """Position of one message."""

    log: int
    channel: Channel
    position: Position
    logged_ns: int = 0


@dataclass(eq=False)
class Stream:
    """All messages of one role, in order of logging."""

    stamps: list[int] = field(default_factory=list)
    located: list[Located] = field(default_factory=list)

    @property
    def stamps_ns(self) -> Int64[np.ndarray, " N"]:
        """Header stamps [ns]."""
        return np.array(self.stamps, np.int64)


@dataclass(eq=False)
class DayIndex:
    """Index of a day's logs; `problems` describes and `damage` counts unreadable parts.

    In `kinds`, the lidar that the others are matched to comes first of the lidars.
    """

    kinds: dict[str, str] = field(default_factory=dict)
    logs: list[LogReader] = field(default_factory=list)
    log_names: list[str] = field(default_factory=list)
    streams: dict[Role, Stream] = field(default_factory=dict)
    # by camera: log, stamp, intrinsics
    cameras: dict[str, list[tuple[int, int, Camera]]] = field(default_factory=dict)
    trees: list[TransformTree] = field(default_factory=list)
    ego: EgoTrack = field(default_factory=EgoTrack)
    messages: Counter[tuple[str, str]] = field(default_factory=Counter)  # by topic of the rig and type
    problems: list[str] = field(default_factory=list)
    encodings_right: set[tuple[int, str]] = field(default_factory=set)  # log and topic
    damage: Counter[str] = field(default_factory=Counter)
    camera_of_bytes: dict[bytes, Camera | str] = field(default_factory=dict)
    reading: Reading | None = None  # None: all of the day is read

    @property
    def anchor(self) -> str:
        """Sensor whose captures define the moments: the first lidar; without sweeps a radar, without scans a camera."""
        able = sorted(self.kinds, key=lambda s: ("lidar", "radar", "camera").index(self.kinds[s]))
        return next((s for s in able if self.captures(s).stamps), able[0] if able else "")

    def captures(self, sensor: str) -> Stream:
        """Images, sweeps or scans of a sensor."""
        return self.stream(Role(CAPTURED[self.kinds[sensor]], sensor)) if sensor else Stream()

    def sweeps_in_bursts(self) -> Int64[np.ndarray, " N"]:
        """Indices of the sweeps that may become moments: all, or those of the reading plan."""
        located = self.captures(self.anchor).located
        if self.reading is None:
            return np.arange(len(located), dtype=np.int64)
        return np.array([i for i, at in enumerate(located) if at.logged_ns in self.reading.bursts], np.int64)

    def stream(self, role: Role) -> Stream:
        """Messages of a role; empty if there are none."""
        return self.streams.setdefault(role, Stream())

    def types_of(self, topic: str) -> dict[str, int]:
        """Number of messages on a topic of the rig by type."""
        return {kind: count for (name, kind), count in self.messages.items() if name == topic}

    @cached_property
    def types_beside(self) -> set[tuple[str, str]]:
        """Topics and types of any messages at the beginning of some logs."""
        found = set[tuple[str, str]]()
        for log in self.logs[:_GLANCES]:
            first_ns = None
            for message in log.scan():
                first_ns = message.log_time_ns if first_ns is None else first_ns
                if message.log_time_ns > first_ns + _GLANCE_NS:
                    break
                found.add((message.channel.topic, message.channel.msgtype))
        return found

    def read(self, located: Located) -> tuple[Any, str]:
        """A decoded message and its frame id; raises one of DECODE_ERRORS."""
        data = self.logs[located.log].read(located.position)
        return decode(located.channel, data), header_frame_id(located.channel, data)

    def camera_at(self, sensor: str, log: int, stamp_ns: int) -> Camera | None:
        """Intrinsics nearest in time within the same log, else in any log; None if no log has any."""
        known = self.cameras.get(sensor, [])
        own = [c for c in known if c[0] == log] or known
        return min(own, key=lambda c: abs(c[1] - stamp_ns))[2] if own else None

    def complain(self, problem: str) -> None:
        """Add a problem, once; unprintable bytes in it become question marks."""
        problem = "".join(c if c.isprintable() else "?" for c in problem.replace("\n", " "))
        if problem not in self.problems:
            self.problems.append(problem)

    def close(self) -> None:
        """Close all logs."""
        for log in self.logs:
            log.close()


def index_logs(paths: Sequence[LogPath], rig: Rig, *, budget: int | None = None) -> DayIndex:
    """Scan the logs once; of images and clouds only the stamp is read. Unreadable logs become problems.

    Args:
        budget: largest number of sweeps; a longer day is read in bursts. None = read the whole day.
    """
    index = DayIndex({role.sensor: role.kind for role in topics_of(rig).values() if role.is_capture})
    _allow_open_files()
    try:
        _open_logs(index, paths)
        _read_day(index, rig, budget)
    except BaseException:  # e.g. the object store does not answer: the open logs must be closed here
        index.close()
        raise
    return index


def _read_day(index: DayIndex, rig: Rig, budget: int | None) -> None:
    topics = topics_of(rig)
    timelines = [None if budget is None else log.timeline() for log in index.logs]
    if budget is not None:
        logs = dict(zip(index.logs, timelines, strict=True))
        index.reading = plan_reading(logs, rig, topics, budget)
    for number, timeline in enumerate(timelines):
        if index.reading is None:
            _read_log(index, number, topics)
        else:
            _read_bursts(index, number, topics, timeline, index.reading.around)
    if budget is not None and index.reading is None and len(index.captures(index.anchor).stamps) > budget:
        _take_bursts(index, timelines, budget)
    for tree in index.trees:
        for other in index.trees:
            tree.fill_from(other)
    for cameras in index.cameras.values():
        cameras.sort(key=lambda c: c[1])


def _open_logs(index: DayIndex, paths: Sequence[LogPath]) -> None:
    cache = ChunkCache()
    for path in paths:
        try:
            index.logs.append(open_log(path, cache))
        except LogError as err:
            index.complain(str(err))
            index.damage["unreadable_logs"] += 1
        else:
            index.log_names.append(path.name)
            index.trees.append(TransformTree())


def _read_log(index: DayIndex, number: int, topics: dict[str, Role], within: Stretches | None = None) -> None:
    log = index.logs[number]
    try:
        for message in log.scan(topics, within):
            _index_message(index, number, message, topics[message.channel.topic])
    except OSError as err:  # a disk or share failed on the way: messages read so far are used
        index.complain(because("lost", log=log.path, error=err))
        index.damage["logs_lost_while_reading"] += 1
        return
    for name, count in log.damage.items():
        index.damage[name] += count
        reason = "cut off" if name == "truncated" else "damage"
        index.complain(because(reason, log=log.path.name, count=count, damage=name.replace("_", " ")))


def _read_bursts(
    index: DayIndex, number: int, topics: dict[str, Role], timeline: Timeline | None, around: Stretches
) -> None:
    """Read the planned stretches of a log, and the topics before them that a driver may log only once."""
    if timeline is None:
        index.complain(because("unread", log=index.log_names[number]))
        index.damage["logs_left_unread"] += 1
        return
    rare, first = rare_topics(timeline, topics)
    known = {TF_STATIC} if any(tree.edges for tree in index.trees) else set()
    known |= {Role(INFO, camera) for camera in index.cameras}
    is_wanted = any(timeline.recorded.touch(*span) for span in around.spans_ns)
    if is_wanted or set(rare.values()) - known:
        _read_log(index, number, rare, first)
    if is_wanted:
        _read_log(index, number, topics, around)


def _take_bursts(index: DayIndex, timelines: Sequence[Timeline | None], budget: int) -> None:
    """Choose the bursts of a long day that had to be read whole, and report the logs that caused this."""
    sweeps = index.captures(index.anchor)
    logged_ns = np.array([at.logged_ns for at in sweeps.located], np.int64)
    index.reading = plan_sweeps(logged_ns, sweeps.stamps_ns, index.ego, budget)
    unusable = [n for n, t in zip(index.log_names, timelines, strict=True) if t is None]
    reason, logs = "no index" if unusable else "log times", ", ".join(unusable[:3])
    index.complain(because(reason, logs=logs, sweeps=len(sweeps.stamps)))


def _allow_open_files() -> None:
    """Raise this process's soft limit of open files to its hard one, for days in many logs."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_OPEN_FILES)
    with suppress(ValueError, OSError):  # if not allowed, logs that cannot be opened are counted and reported
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _index_message(index: DayIndex, number: int, message: RawMessage, role: Role) -> None:
    index.messages[message.channel.topic, message.channel.msgtype] += 1
    if message.channel.msgtype not in ACCEPTED_TYPES[role.what]:
        index.damage["wrong_type"] += 1
        index.complain(f"{index.log_names[number]}, topic {message.channel.topic}: {_refusal(message, role)}")
    elif role == TF_STATIC:
        _take_transforms(index, number, message)
    elif _is_of_another_encoding(index, number, message):
        index.damage["wrong_encoding"] += 1
    else:
        _take(index, number, message, role)


def _take(index: DayIndex, number: int, message: RawMessage, role: Role) -> None:
    """Index a message that begins with a header."""
    stamp = header_stamp_ns(message.channel, message.data)
    if stamp is None:
        index.damage[f"{role.what}_without_stamp"] += 1
    elif role.what == INFO:
        _take_camera(index, number, stamp, message, role)
    elif role == ODOMETRY:
        _take_odometry(index, stamp, message)
    else:
        index.stream(role).stamps.append(stamp)
        where = Located(number, message.channel, message.position, message.log_time_ns)
        index.stream(role).located.append(where)


def _is_of_another_encoding(index: DayIndex, number: int, message: RawMessage) -> bool:
    """Whether a message has another encoding than its log claims; checked until a topic's first good one.

    Each message is judged by itself: a flipped bit must not cost a topic.
    """
    of = (number, message.channel.topic)
    if of in index.encodings_right:
        return False
    fault = encoding_fault(message.channel, message.data)
    if fault:
        index.complain(
            f"{index.log_names[number]}, topic {message.channel.topic}: {message.channel.msgtype} {fault}"
        )
    else:
        index.encodings_right.add(of)
    return bool(fault)


def _refusal(message: RawMessage, role: Role) -> str:
    """Reason why a message of this type does not fit the topic's role in the rig."""
    found = message.channel.msgtype or "no type"
    reason = REFUSED.get(found.removeprefix("foxglove.").removeprefix("foxglove_msgs/msg/"))
    return f"{found}: {reason}" if reason else f"{found}, not {' or '.join(ACCEPTED_TYPES[role.what])}"


def _take_transforms(index: DayIndex, number: int, message: RawMessage) -> None:
    try:
        index.damage["bad_transforms"] += index.trees[number].add_message(
            decode(message.channel, message.data)
        )
    except DECODE_ERRORS as err:
        index.damage["tf_static_undecodable"] += 1
        index.complain(f"{index.log_names[number]}: {err}")


def _take_odometry(index: DayIndex, stamp: int, message: RawMessage) -> None:
    try:
        if not index.ego.add(stamp, decode(message.channel, message.data)):
            index.damage["bad_odometry"] += 1
    except DECODE_ERRORS:
        index.damage["odometry_undecodable"] += 1


def _take_camera(index: DayIndex, number: int, stamp: int, message: RawMessage, role: Role) -> None:
    index.stream(role).stamps.append(stamp)
    content = content_without_stamp(message.channel, message.data)  # often constant for hours
    camera = index.camera_of_bytes.get(content)
    if camera is None:
        try:
            camera = read_camera_info(decode(message.channel, message.data))
        except DECODE_ERRORS as err:
            camera = str(err)
        if len(index.camera_of_bytes) < _MOST_CAMERAS:
            index.camera_of_bytes[content] = camera
    if isinstance(camera, str):
        index.damage["camera_info_unusable"] += 1
        index.complain(f"{index.log_names[number]}, topic {message.channel.topic}: {camera}")
        return
    # For "nearest" one entry per change and log is enough: keep the first and the last of each run.
    known = index.cameras.setdefault(role.sensor, [])
    if len([c for c in known[-2:] if c[0] == number and c[2] is camera]) == 2:
        known.pop()
    known.append((number, stamp, camera))
