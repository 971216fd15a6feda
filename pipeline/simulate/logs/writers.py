"""Writes messages as ROS 2 MCAP (zstd chunks), ROS 1 bag or ROS 2 bag folder (sqlite3); one interface, same content."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer

from pipeline.rig.topics import TOPICS
from pipeline.simulate.logs.messages import Messages

__all__ = ["CONTAINERS", "OpenLog", "log_name", "open_log"]

CONTAINERS: Final = ("mcap", "ros1", "db3")


class OpenLog(NamedTuple):
    """A log open for writing: makes its messages, and writes them by put(topic, stamp_ns, message)."""

    messages: Messages
    put: Callable[[str, int, Any], None]


def log_name(stem: str, container: str) -> str:
    """File (or folder) name of a log."""
    return {"mcap": f"{stem}.mcap", "ros1": f"{stem}.bag", "db3": stem}[container]


@contextmanager
def open_log(path: Path, container: str) -> Iterator[OpenLog]:
    """A log that appears under its name, in place of an old one, when the block has ended without an error."""
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
    messages = Messages(2)
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4 << 20, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="boresight-simulate")

        def put(topic: str, stamp_ns: int, message: Any) -> None:
            if topic not in channels:
                name = message.__msgtype__
                text = messages.typestore.generate_msgdef(name, ros_version=2)[0]
                schema = writer.register_schema(name=name, encoding="ros2msg", data=text.encode())
                channels[topic] = writer.register_channel(
                    topic=topic, message_encoding="cdr", schema_id=schema
                )
            writer.add_message(
                channels[topic], log_time=stamp_ns, publish_time=stamp_ns, data=messages.serialised(message)
            )

        yield OpenLog(messages, put)
        writer.finish()


@contextmanager
def _ros1(path: Path) -> Iterator[OpenLog]:
    messages = Messages(1)
    connections: dict[str, Any] = {}
    writer = Bag1Writer(path)
    writer.set_compression(Bag1Writer.CompressionFormat.LZ4)
    with writer:

        def put(topic: str, stamp_ns: int, message: Any) -> None:
            if topic not in connections:
                latch = 1 if topic == TOPICS["tf"] else None
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=messages.typestore, latching=latch
                )
            writer.write(connections[topic], stamp_ns, messages.serialised(message))

        yield OpenLog(messages, put)


@contextmanager
def _db3(path: Path) -> Iterator[OpenLog]:
    messages = Messages(2)
    connections: dict[str, Any] = {}
    with Bag2Writer(path, version=9) as writer:

        def put(topic: str, stamp_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=messages.typestore
                )
            writer.write(connections[topic], stamp_ns, messages.serialised(message))

        yield OpenLog(messages, put)
