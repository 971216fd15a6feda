"""A recording as a ROS 2 MCAP, and the fleet.toml of several."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.convert.recording import EgoMotion, Recording, image_format
from pipeline.ros_messages import RosMessages
from pipeline.store.atomic_write import atomic_write

__all__ = ["FRAMES", "TOPICS", "fleet_text", "write_log"]

TOPICS = {
    "image": "/camera/front/image/compressed",
    "info": "/camera/front/camera_info",
    "lidar": "/lidar/top/points",
    "radar": "/radar/front/points",
    "ego": "/vehicle/odometry",
    "tf": "/tf_static",
}
FRAMES = {"camera": "camera_front_optical", "lidar": "lidar_top", "radar": "radar_front", "base": "base_link"}


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
            poses = recording.T_base.items()
            log.put(
                "tf", first_ns, _ros().transforms((_at(first_ns, "base"), FRAMES[s], T) for s, T in poses)
            )
        for event in recording.events:
            held, at_ns = event.load(), event.stamp_ns
            if event.kind == "image":
                log.put("image", at_ns, _ros().image(_at(at_ns, "camera"), held, image_format(held)))
                log.put("info", at_ns, _ros().camera_info(_at(at_ns, "camera"), recording.camera))
            elif event.kind == "ego":
                log.put("ego", at_ns, _odometry(at_ns, held))
            else:
                log.put(event.kind, at_ns, _ros().cloud(_at(at_ns, event.kind), held))
        return log.finish()


def fleet_text(
    name: str, vehicles: Sequence[str], models: tuple[str, str] | None, *, ego: bool, radar: bool = True
) -> str:
    """fleet.toml of converted logs.

    Args:
        name: of the fleet.
        vehicles: all on one rig.
        models: manifests of a segmenter and a detector; None names topics for semantics that the logs do not hold.
        ego: the logs hold odometry.
        radar: the logs hold scans of a radar.
    """
    if models is None:
        semantics = {
            "source": "topics",
            "labels": "/perception/camera/labels",
            "detections": "/perception/camera/detections",
        }
    else:
        semantics = {"source": "onnx", "segmenter": models[0], "detector": models[1]}
    inline = ", ".join(f"{key} = {json.dumps(value)}" for key, value in semantics.items())
    scans = f'points = "{TOPICS["radar"]}"\ndoppler_field = "doppler"\ndoppler_positive = "receding"'
    lines = [
        f"[fleet]\nname = {json.dumps(name)}",
        f'[rigs.default.camera]\nimage = "{TOPICS["image"]}"\ninfo = "{TOPICS["info"]}"\nsemantics = {{ {inline} }}',
        f'[rigs.default.lidar]\npoints = "{TOPICS["lidar"]}"',
        *([f"[rigs.default.radar]\n{scans}"] if radar else []),
        *([f'[rigs.default.ego]\nodometry = "{TOPICS["ego"]}"'] if ego else []),
        '[rigs.default.prior]\nsource = "tf_static"',
        *(f'[vehicles.{json.dumps(vehicle)}]\nrig = "default"' for vehicle in vehicles),
    ]
    return "\n".join(lines) + "\n"


@cache
def _ros() -> RosMessages:
    return RosMessages(get_typestore(Stores.ROS2_HUMBLE), 2)


class _Log:
    """An open MCAP that knows its channels."""

    def __init__(self, writer: Writer) -> None:
        self._writer, self._channels, self._count = writer, dict[str, int](), 0
        writer.start(profile="ros2", library="boresight-convert")

    def put(self, role: str, stamp_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if role not in self._channels:
            text = _ros().typestore.generate_msgdef(kind, ros_version=2)[0]
            schema = self._writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            self._channels[role] = self._writer.register_channel(
                topic=TOPICS[role], message_encoding="cdr", schema_id=schema
            )
        data = _ros().serialised(message)
        self._writer.add_message(self._channels[role], log_time=stamp_ns, publish_time=stamp_ns, data=data)
        self._count += 1

    def finish(self) -> int:
        self._writer.finish()
        return self._count


def _at(stamp_ns: int, frame: str) -> Any:
    return _ros().header(stamp_ns, FRAMES[frame])


def _odometry(stamp_ns: int, motion: EgoMotion) -> Any:
    header, child = _ros().header(stamp_ns, "odom"), FRAMES["base"]
    return _ros().odometry(header, child, motion.T_odom_base, motion.speed_mps, motion.yaw_rate_radps)
