"""A drive of a data set: intrinsics, poses on the car, events of each sensor; its files of numbers; the MCAP."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.errors import ConfigError
from pipeline.core.ros_messages import McapLog, RosMessages
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind
from pipeline.rig.se3 import inverse, log_so3
from pipeline.rig.topics import TOPICS, frame_of, topics_of
from pipeline.store.atomic_write import atomic_write

__all__ = [
    "Event", "Recording", "ego_events", "fleet_text", "read_bytes", "read_float_rows", "read_json",
    "read_pcd", "write_log",
]  # fmt: skip

_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


class Event(NamedTuple):
    """One measurement; `load` returns JPEG or PNG bytes, columns of points by name, or motion.

    Motion is T_odom_base, forward speed [m/s], yaw rate [rad/s, positive to the left].
    """

    stamp_ns: int
    sensor: str  # name of the sensor, or ego
    load: Callable[[], Any]


@dataclass(frozen=True, eq=False)
class Recording:
    """One drive.

    Args:
        T_base: T_base_sensor of cameras (optical), lidars and radars (both x forward, y left, z up), by name.
        events: in order of their stamps; radar columns hold x, y, z, doppler (range rate, positive =
            receding).
    """

    vehicle: str
    day: str
    name: str
    kinds: Mapping[str, Kind]
    cameras: Mapping[str, Camera]
    T_base: Mapping[str, Float[np.ndarray, "4 4"]]
    events: Sequence[Event]


def ego_events(stamps_ns: Sequence[int], T_odom_base: Sequence[Float[np.ndarray, "4 4"]]) -> list[Event]:
    """Odometry from poses at increasing stamps: motion between neighbours."""
    events = []
    for k, (stamp, T) in enumerate(zip(stamps_ns, T_odom_base, strict=True)):
        before, after = max(k - 1, 0), min(k + 1, len(stamps_ns) - 1)
        dt_s = (stamps_ns[after] - stamps_ns[before]) / 1e9
        if dt_s <= 0:
            continue
        step = inverse(T_odom_base[before]) @ T_odom_base[after]
        motion = T, float(step[0, 3] / dt_s), float(log_so3(step[:3, :3])[2] / dt_s)
        events.append(Event(stamp, "ego", partial(tuple, motion)))
    return events


def read_bytes(path: Path) -> bytes:
    """Content of a file; raises ConfigError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as err:
        raise ConfigError(str(path), "", f"cannot be read: {err.strerror}") from err


def read_json(path: Path) -> Any:
    """Value of a JSON file; raises ConfigError if it cannot be read, or is not JSON."""
    try:
        return json.loads(read_bytes(path))
    except ValueError as err:
        raise ConfigError(str(path), "", f"not readable JSON: {err}") from err


def read_float_rows(path: Path, columns: int) -> Float32[np.ndarray, "N C"]:
    """Rows of little-endian float32, as in KITTI's .bin; raises ConfigError if the size does not fit."""
    data = read_bytes(path)
    if len(data) % (4 * columns):
        raise ConfigError(str(path), "", f"{len(data)} bytes are not rows of {columns} float32")
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def read_pcd(path: Path) -> np.ndarray:
    """Points of a binary PCD 0.7 file; raises ConfigError if missing, or its header does not fit its size."""
    data = read_bytes(path)
    head, separator, body = data.partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    header = {line[0]: line[1:] for line in lines if line}
    try:
        columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], strict=True)
        dtype = np.dtype([(name, f"<{_PCD_TYPES[kind]}{size}") for name, kind, size in columns])
        count = int(header["POINTS"][0])
        is_single = set(header.get("COUNT", ["1"])) == {"1"}
    except (KeyError, IndexError, ValueError, TypeError) as err:
        raise ConfigError(str(path), "", f"not a readable PCD: {type(err).__name__} {err}") from err
    if not separator or not is_single or len(body) < count * dtype.itemsize:
        raise ConfigError(str(path), "DATA", f"needs {count} binary points of single numbers")
    return np.frombuffer(body, dtype, count)


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
    name: str, vehicles: Sequence[str], kinds: Mapping[str, Kind], models: tuple[str, str] | None, *,
    ego: bool, base: bool,
) -> str:  # fmt: skip
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
