"""A recording as a ROS 2 MCAP, and the fleet.toml of several."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.convert.recording import EgoMotion, Event, Recording, image_format
from pipeline.rig.graph import Kind
from pipeline.rig.topics import TOPICS, frame_of, topics_of
from pipeline.ros_messages import RosMessages
from pipeline.store.atomic_write import atomic_write

__all__ = ["fleet_text", "write_log"]


def write_log(path: Path, recording: Recording) -> int:
    """Write a recording, one message in memory at a time; returns how many messages there are.

    Raises:
        ConfigError: a file of the data set is not what its format promises; no log is left then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        log = _Log(Writer(stream, chunk_size=4 << 20, compression=CompressionType.ZSTD))
        if recording.events:
            first_ns = recording.events[0].stamp_ns
            poses = ((_at(first_ns, "base"), frame_of(s), T) for s, T in recording.T_base.items())
            log.put(TOPICS["tf"], first_ns, _ros().transforms(poses))
        for event in recording.events:
            for topic, message in _messages(recording, event):
                log.put(topic, event.stamp_ns, message)
        return log.finish()


def _messages(recording: Recording, event: Event) -> list[tuple[str, Any]]:
    """(topic, message) of what one sensor saw."""
    held, name, at_ns = event.load(), event.sensor, event.stamp_ns
    if name == "ego":
        return [(TOPICS["odometry"], _odometry(at_ns, held))]
    topics = topics_of(name, recording.kinds[name])
    if name not in recording.cameras:
        return [(topics["points"], _ros().cloud(_at(at_ns, name), held))]
    return [
        (topics["image"], _ros().image(_at(at_ns, name), held, image_format(held))),
        (topics["info"], _ros().camera_info(_at(at_ns, name), recording.cameras[name])),
    ]


def fleet_text(
    name: str,
    vehicles: Sequence[str],
    kinds: Mapping[str, Kind],
    models: tuple[str, str] | None,
    *,
    ego: bool,
    base: bool,
) -> str:
    """fleet.toml of converted logs.

    Args:
        name: of the fleet.
        vehicles: all on one rig.
        kinds: of the rig's sensors, by name.
        models: manifests of a segmenter and a detector; None names topics for semantics that the logs do not hold.
        ego: the logs hold odometry.
        base: the frame that poses are given in is the vehicle's.
    """
    is_short = all(sensor == kind for sensor, kind in kinds.items())
    lines = [
        f"[fleet]\nname = {json.dumps(name)}",
        *([f"[rigs.default]\nbase = {json.dumps(frame_of('base'))}"] if base and not is_short else []),
        *(_section(sensor, kind, models) for sensor, kind in kinds.items()),
        *([f'[rigs.default.ego]\nodometry = "{TOPICS["odometry"]}"'] if ego else []),
        '[rigs.default.prior]\nsource = "tf_static"',
        *(f'[vehicles.{json.dumps(vehicle)}]\nrig = "default"' for vehicle in vehicles),
    ]
    return "\n".join(lines) + "\n"


def _section(sensor: str, kind: Kind, models: tuple[str, str] | None) -> str:
    topics = topics_of(sensor, kind)
    head = f"[rigs.default.{kind if sensor == kind else f'{kind}s.{sensor}'}]"
    if kind == "camera":
        if models is None:
            semantics = {"source": "topics"} | {n: topics[n] for n in ("labels", "detections")}
        else:
            semantics = {"source": "onnx", "segmenter": models[0], "detector": models[1]}
        inline = ", ".join(f"{key} = {json.dumps(value)}" for key, value in semantics.items())
        image, info = topics["image"], topics["info"]
        return f'{head}\nimage = "{image}"\ninfo = "{info}"\nsemantics = {{ {inline} }}'
    doppler = '\ndoppler_field = "doppler"\ndoppler_positive = "receding"' if kind == "radar" else ""
    return f'{head}\npoints = "{topics["points"]}"{doppler}'


@cache
def _ros() -> RosMessages:
    return RosMessages(get_typestore(Stores.ROS2_HUMBLE), 2)


class _Log:
    """An open MCAP that knows its channels."""

    def __init__(self, writer: Writer) -> None:
        self._writer, self._channels, self._count = writer, dict[str, int](), 0
        writer.start(profile="ros2", library="boresight-convert")

    def put(self, topic: str, stamp_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._channels:
            text = _ros().typestore.generate_msgdef(kind, ros_version=2)[0]
            schema = self._writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=schema
            )
        data = _ros().serialised(message)
        self._writer.add_message(self._channels[topic], log_time=stamp_ns, publish_time=stamp_ns, data=data)
        self._count += 1

    def finish(self) -> int:
        self._writer.finish()
        return self._count


def _at(stamp_ns: int, frame: str) -> Any:
    return _ros().header(stamp_ns, frame_of(frame))


def _odometry(stamp_ns: int, motion: EgoMotion) -> Any:
    header, child = _ros().header(stamp_ns, "odom"), frame_of("base")
    return _ros().odometry(header, child, motion.T_odom_base, motion.speed_mps, motion.yaw_rate_radps)
