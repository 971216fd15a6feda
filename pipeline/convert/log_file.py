"""A recording as a ROS 2 MCAP, and the fleet.toml of several."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.convert.recording import EgoMotion, Recording, image_format
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import to_quaternion
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
_DATATYPES = {"f4": 7, "u2": 4, "u1": 2}  # sensor_msgs/PointField


def write_log(path: Path, recording: Recording) -> int:
    """Write a recording, one message in memory at a time; returns how many messages there are.

    Raises:
        ConfigError: a file of the data set is not what its format promises; no log is left then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        log = _Log(Writer(stream, chunk_size=4 << 20, compression=CompressionType.ZSTD))
        if recording.events:
            log.put("tf", recording.events[0].stamp_ns, _transforms(recording))
        for event in recording.events:
            held = event.load()
            if event.kind == "image":
                log.put("image", event.stamp_ns, _image(event.stamp_ns, held))
                log.put("info", event.stamp_ns, _info(event.stamp_ns, recording.camera))
            elif event.kind == "ego":
                log.put("ego", event.stamp_ns, _odometry(event.stamp_ns, held))
            else:
                log.put(event.kind, event.stamp_ns, _cloud(event.stamp_ns, event.kind, held))
        return log.finish()


def fleet_text(name: str, vehicles: Sequence[str], models: tuple[str, str] | None, *, ego: bool) -> str:
    """fleet.toml of converted logs.

    Args:
        name: of the fleet.
        vehicles: all on one rig.
        models: manifests of a segmenter and a detector; None names topics for semantics that the logs do not hold.
        ego: the logs hold odometry.
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
    lines = [
        f"[fleet]\nname = {json.dumps(name)}",
        f'[rigs.default.camera]\nimage = "{TOPICS["image"]}"\ninfo = "{TOPICS["info"]}"\nsemantics = {{ {inline} }}',
        f'[rigs.default.lidar]\npoints = "{TOPICS["lidar"]}"',
        f'[rigs.default.radar]\npoints = "{TOPICS["radar"]}"\ndoppler_field = "doppler"\ndoppler_positive = "receding"',
        *([f'[rigs.default.ego]\nodometry = "{TOPICS["ego"]}"'] if ego else []),
        '[rigs.default.prior]\nsource = "tf_static"',
        *(f'[vehicles.{json.dumps(vehicle)}]\nrig = "default"' for vehicle in vehicles),
    ]
    return "\n".join(lines) + "\n"


@cache
def _typestore() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


class _Log:
    """An open MCAP that knows its channels."""

    def __init__(self, writer: Writer) -> None:
        self._writer, self._channels, self._count = writer, dict[str, int](), 0
        writer.start(profile="ros2", library="boresight-convert")

    def put(self, role: str, stamp_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if role not in self._channels:
            text = _typestore().generate_msgdef(kind, ros_version=2)[0]
            schema = self._writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            self._channels[role] = self._writer.register_channel(
                topic=TOPICS[role], message_encoding="cdr", schema_id=schema
            )
        data = bytes(_typestore().serialize_cdr(message, kind))
        self._writer.add_message(self._channels[role], log_time=stamp_ns, publish_time=stamp_ns, data=data)
        self._count += 1

    def finish(self) -> int:
        self._writer.finish()
        return self._count


def _new(kind: str, **fields: Any) -> Any:
    package, name = kind.split("/")
    return _typestore().types[f"{package}/msg/{name}"](**fields)


def _header(stamp_ns: int, frame_id: str) -> Any:
    stamp = _new("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return _new("std_msgs/Header", stamp=stamp, frame_id=frame_id)


def _image(stamp_ns: int, data: bytes) -> Any:
    return _new(
        "sensor_msgs/CompressedImage",
        header=_header(stamp_ns, FRAMES["camera"]),
        format=image_format(data),
        data=np.frombuffer(data, np.uint8),
    )


def _info(stamp_ns: int, camera: Camera) -> Any:
    P = np.hstack([camera.K, np.zeros((3, 1))])
    roi = _new("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _new(
        "sensor_msgs/CameraInfo",
        header=_header(stamp_ns, FRAMES["camera"]),
        height=camera.height_px,
        width=camera.width_px,
        distortion_model=camera.model,
        d=np.asarray(camera.D, np.float64),
        k=camera.K.astype(np.float64).ravel(),
        r=np.eye(3).ravel(),
        p=P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def _cloud(stamp_ns: int, sensor: str, columns: Mapping[str, np.ndarray]) -> Any:
    dtype = np.dtype([(name, c.dtype.newbyteorder("<")) for name, c in columns.items()])
    rows = np.empty(len(next(iter(columns.values()))), dtype)
    fields, offset = [], 0
    for name, c in columns.items():
        rows[name] = c
        kind = _DATATYPES[f"{c.dtype.kind}{c.dtype.itemsize}"]
        fields.append(_new("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1))
        offset += c.dtype.itemsize
    return _new(
        "sensor_msgs/PointCloud2",
        header=_header(stamp_ns, FRAMES[sensor]),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )


def _transforms(recording: Recording) -> Any:
    header = _header(recording.events[0].stamp_ns, FRAMES["base"])
    items = []
    for sensor, T in recording.T_base.items():
        q = _quaternion(T)
        t = _new("geometry_msgs/Vector3", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
        transform = _new("geometry_msgs/Transform", translation=t, rotation=q)
        child = FRAMES[sensor]
        items.append(
            _new("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)
        )
    return _new("tf2_msgs/TFMessage", transforms=items)


def _odometry(stamp_ns: int, motion: EgoMotion) -> Any:
    T, zero = motion.T_odom_base, {"x": 0.0, "y": 0.0, "z": 0.0}
    position = _new("geometry_msgs/Point", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
    pose = _new("geometry_msgs/Pose", position=position, orientation=_quaternion(T))
    twist = _new(
        "geometry_msgs/Twist",
        linear=_new("geometry_msgs/Vector3", **(zero | {"x": motion.speed_mps})),
        angular=_new("geometry_msgs/Vector3", **(zero | {"z": motion.yaw_rate_radps})),
    )
    return _new(
        "nav_msgs/Odometry",
        header=_header(stamp_ns, "odom"),
        child_frame_id=FRAMES["base"],
        pose=_new("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=_new("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def _quaternion(T: Float[np.ndarray, "4 4"]) -> Any:
    w, x, y, z = (float(v) for v in to_quaternion(T))
    return _new("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
