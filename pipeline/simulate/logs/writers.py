"""Writers for ROS 2 MCAP (zstd chunks), ROS 1 bag and ROS 2 bag folder (sqlite3), with equal content."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer

from pipeline.core.ros_messages import McapLog, RosMessages
from pipeline.rig.topics import TOPICS

__all__ = ["CONTAINERS", "OpenLog", "log_name", "open_log"]

CONTAINERS: Final = ("mcap", "ros1", "db3")


class OpenLog(NamedTuple):
    """A log open for writing: creates messages, and writes them with put(topic, stamp_ns, message)."""

    messages: RosMessages
    put: Callable[[str, int, Any], None]


def log_name(stem: str, container: str) -> str:
    """File (or folder) name of a log."""
    return {"mcap": f"{stem}.mcap", "ros1": f"{stem}.bag", "db3": stem}[container]


@contextmanager
def open_log(path: Path, container: str) -> Iterator[OpenLog]:
    """Open a log; it gets its final name, replacing an old one, when the block ends without an error."""
    partial = path.parent / f".partial-{path.name}"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    opener = {"mcap": _mcap, "ros1": _ros1, "db3": _db3}[container]
    try:
        with opener(partial / path.name) as log:
            yield log
        if path.is_dir():
            shutil.rmtree(path)
        (partial / path.name).replace(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _mcap(path: Path) -> Iterator[OpenLog]:
    with path.open("wb") as file:
        log = McapLog(file, "boresight-simulate")
        yield OpenLog(log.messages, log.put)
        log.writer.finish()


def _ros1(path: Path) -> AbstractContextManager[OpenLog]:
    writer = Bag1Writer(path)
    writer.set_compression(Bag1Writer.CompressionFormat.LZ4)
    return _bag(writer, RosMessages(1), latched={TOPICS["tf"]: {"latching": 1}})


def _db3(path: Path) -> AbstractContextManager[OpenLog]:
    return _bag(Bag2Writer(path, version=9), RosMessages(2), latched={})


@contextmanager
def _bag(writer: Any, messages: RosMessages, latched: dict[str, dict[str, int]]) -> Iterator[OpenLog]:
    connections: dict[str, Any] = {}
    with writer:

        def put(topic: str, stamp_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=messages.typestore, **latched.get(topic, {})
                )
            writer.write(connections[topic], stamp_ns, messages.serialised(message))

        yield OpenLog(messages, put)
