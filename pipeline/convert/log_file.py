"""A recording as a ROS 2 MCAP, and a fleet.toml for several recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.convert.recording import Event, Recording
from pipeline.core.ros_messages import McapLog, RosMessages
from pipeline.rig.graph import Kind
from pipeline.rig.topics import TOPICS, frame_of, topics_of
from pipeline.store.atomic_write import atomic_write

__all__ = ["fleet_text", "write_log"]


def write_log(path: Path, recording: Recording) -> int:
    """Write a recording; returns the number of messages. One message is in memory at a time.

    Raises:
        ConfigError: a file of the data set violates its format; then no log is left.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        log, count = McapLog(stream, "boresight-convert"), 0
        for event in recording.events:
            messages = _messages(log.messages, recording, event)
            if not count:
                poses = log.messages.sensor_poses(event.stamp_ns, recording.T_base)
                messages = [(TOPICS["tf"], poses), *messages]
            for topic, message in messages:
                log.put(topic, event.stamp_ns, message)
            count += len(messages)
        log.writer.finish()
        return count


def _messages(ros: RosMessages, recording: Recording, event: Event) -> list[tuple[str, Any]]:
    """(topic, message) pairs of one event."""
    held, name, at_ns = event.load(), event.sensor, event.stamp_ns
    if name == "ego":
        return [(TOPICS["odometry"], ros.odometry(at_ns, *held))]
    topics, header = topics_of(name, recording.kinds[name]), ros.at(at_ns, name)
    if name not in recording.cameras:
        return [(topics["points"], ros.cloud(header, held))]
    image = ros.image(header, held, "png" if held.startswith(b"\x89PNG") else "jpeg")
    return [(topics["image"], image), (topics["info"], ros.camera_info(header, recording.cameras[name]))]


_TURN = '\nturn = { sense = "right", begins_deg = 180.0 }'


def fleet_text(
    name: str,
    vehicles: Sequence[str],
    kinds: Mapping[str, Kind],
    models: tuple[str, str] | None,
    *,
    ego: bool,
    base: bool,
) -> str:
    """Text of fleet.toml for converted logs.

    Args:
        models: manifests of a segmenter and a detector; None = topics for semantics, which the logs do not
            have yet.
        base: whether the frame of the poses is the vehicle's.
    """
    is_short = all(sensor == kind for sensor, kind in kinds.items())
    # KITTI's own lidar, whose clouds have no time per point; data sets of its shape with a radar have others.
    turn = _TURN if name == "kitti" and "radar" not in kinds.values() else ""
    lines = [
        f"[fleet]\nname = {json.dumps(name)}",
        *([f"[rigs.default]\nbase = {json.dumps(frame_of('base'))}"] if base and not is_short else []),
        *(_section(sensor, kind, models) + turn * (kind == "lidar") for sensor, kind in kinds.items()),
        *([f'[rigs.default.ego]\nodometry = "{TOPICS["odometry"]}"'] if ego else []),
        '[rigs.default.prior]\nsource = "tf_static"',
        *(f'[vehicles.{json.dumps(vehicle)}]\nrig = "default"' for vehicle in vehicles),
    ]
    return "\n".join(lines) + "\n"


def _section(sensor: str, kind: Kind, models: tuple[str, str] | None) -> str:
    topics = topics_of(sensor, kind)
    head = f"[rigs.default.{kind if sensor == kind else f'{kind}s.{sensor}'}]"
    if kind == "camera":
        semantics = {"source": "topics"} | {n: topics[n] for n in ("labels", "detections")}
        if models is not None:
            semantics = {"source": "onnx", "segmenter": models[0], "detector": models[1]}
        inline = ", ".join(f"{key} = {json.dumps(value)}" for key, value in semantics.items())
        return f'{head}\nimage = "{topics["image"]}"\ninfo = "{topics["info"]}"\nsemantics = {{ {inline} }}'
    doppler = '\ndoppler_field = "doppler"\ndoppler_positive = "receding"' if kind == "radar" else ""
    return f'{head}\npoints = "{topics["points"]}"{doppler}'
