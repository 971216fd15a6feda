"""ROS messages and MCAP files from plain arrays: used by the simulator, `convert` and `export`.

Some bags contain no message definitions (ROS 2 Humble and older), and rosbags does not bundle all. When
reading a log, those of this module are used only if the log itself has no definition; a message that does
not fit byte for byte is refused. Logs that are written here use the same definitions. Source: vision_msgs
4.1 (Humble); radar_msgs 0.2 (Humble).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from io import BufferedIOBase
from typing import Any, BinaryIO, Final

import numpy as np
from jaxtyping import Float
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import to_quaternion
from pipeline.rig.topics import frame_of

__all__ = ["DEFINITIONS", "McapLog", "RosMessages", "register"]

_DATATYPES: Final = {"f4": 7, "u2": 4, "u1": 2}  # sensor_msgs/PointField
# type -> (types that it needs, text)
DEFINITIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "vision_msgs/msg/Point2D": ((), "float64 x\nfloat64 y\n"),
    "vision_msgs/msg/Pose2D": ((), "vision_msgs/Point2D position\nfloat64 theta\n"),
    "vision_msgs/msg/BoundingBox2D": ((), "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"),
    "vision_msgs/msg/ObjectHypothesis": ((), "string class_id\nfloat64 score\n"),
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        (),
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    "vision_msgs/msg/Detection2D": (
        (),
        (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox2D bbox\nstring id\n"
        ),
    ),
    "vision_msgs/msg/Detection2DArray": (
        (
            "vision_msgs/msg/Point2D",
            "vision_msgs/msg/Pose2D",
            "vision_msgs/msg/BoundingBox2D",
            "vision_msgs/msg/ObjectHypothesis",
            "vision_msgs/msg/ObjectHypothesisWithPose",
            "vision_msgs/msg/Detection2D",
        ),
        "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    ),
    "radar_msgs/msg/RadarReturn": (
        (),
        "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\nfloat32 amplitude\n",
    ),
    "radar_msgs/msg/RadarScan": (
        ("radar_msgs/msg/RadarReturn",),
        "std_msgs/Header header\nradar_msgs/RadarReturn[] returns\n",
    ),
    "radar_msgs/msg/RadarTrack": (
        (),
        (
            "unique_identifier_msgs/UUID uuid\n"
            "geometry_msgs/Point position\ngeometry_msgs/Vector3 velocity\n"
            "geometry_msgs/Vector3 acceleration\ngeometry_msgs/Vector3 size\nuint16 classification\n"
            "float32[6] position_covariance\nfloat32[6] velocity_covariance\n"
            "float32[6] acceleration_covariance\n"
            "float32[6] size_covariance\n"
        ),
    ),
    "radar_msgs/msg/RadarTracks": (
        ("radar_msgs/msg/RadarTrack",),
        "std_msgs/Header header\nradar_msgs/RadarTrack[] tracks\n",
    ),
}


@lru_cache(maxsize=2)
def _typestore(ros_version: int) -> Typestore:
    """Type store with all types that are written; built once per process."""
    store = get_typestore(Stores.ROS1_NOETIC if ros_version == 1 else Stores.ROS2_HUMBLE)
    register(store, "vision_msgs/msg/Detection2DArray")
    if ros_version == 1:
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    return store


class RosMessages:
    """Makes and serialises messages of ROS version 1 or 2 (Humble); headers: `header` or `at`."""

    def __init__(self, ros_version: int) -> None:
        self.typestore, self.ros_version = _typestore(ros_version), ros_version

    def make(self, name: str, /, **fields: Any) -> Any:
        """An empty message of a type, such as "sensor_msgs/PointCloud2"."""
        package, short = name.split("/")
        return self.typestore.types[f"{package}/msg/{short}"](**fields)

    def serialised(self, message: Any) -> bytes:
        """Wire bytes of a message."""
        pack = self.typestore.serialize_ros1 if self.ros_version == 1 else self.typestore.serialize_cdr
        return bytes(pack(message, message.__msgtype__))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Header."""
        time = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 0} if self.ros_version == 1 else {}
        return self.make("std_msgs/Header", stamp=time, frame_id=frame_id, **seq)

    def at(self, stamp_ns: int, sensor: str) -> Any:
        """Header of a message of a sensor or the vehicle ("base"), with its frame id."""
        return self.header(stamp_ns, frame_of(sensor))

    def image(self, header: Any, data: bytes, encoding: str) -> Any:
        """CompressedImage."""
        pixels = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/CompressedImage", header=header, format=encoding, data=pixels)

    def camera_info(self, header: Any, camera: Camera) -> Any:
        """CameraInfo of an unrectified image."""
        roi = self.make(
            "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        names = ("D", "K", "R", "P") if self.ros_version == 1 else ("d", "k", "r", "p")
        values = (
            np.asarray(camera.D, np.float64),
            camera.K.ravel().astype(np.float64),
            np.eye(3).ravel(),
            np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        )
        return self.make(
            "sensor_msgs/CameraInfo", header=header, height=camera.height_px, width=camera.width_px,
            distortion_model=camera.model, binning_x=0, binning_y=0, roi=roi,
            **dict(zip(names, values, strict=True)),
        )  # fmt: skip

    def cloud(self, header: Any, columns: Mapping[str, np.ndarray]) -> Any:
        """PointCloud2 of columns of float32, uint16 and uint8 (N each), packed in this order."""
        dtype = np.dtype([(name, c.dtype.newbyteorder("<")) for name, c in columns.items()])
        rows = np.empty(len(next(iter(columns.values()))), dtype)
        fields, offset = [], 0
        for name, c in columns.items():
            rows[name] = c
            kind = _DATATYPES[f"{c.dtype.kind}{c.dtype.itemsize}"]
            fields.append(
                self.make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)
            )
            offset += c.dtype.itemsize
        return self.make(
            "sensor_msgs/PointCloud2", header=header, height=1, width=len(rows), fields=fields,
            is_bigendian=False, point_step=dtype.itemsize, row_step=dtype.itemsize * len(rows),
            data=np.frombuffer(rows.tobytes(), np.uint8), is_dense=True,
        )  # fmt: skip

    def transforms(self, of_child: Iterable[tuple[Any, str, Float[np.ndarray, "4 4"]]]) -> Any:
        """TFMessage from (header with the parent's frame, child frame, T_parent_child)."""
        items = []
        for header, child, T in of_child:
            x, y, z = (float(v) for v in T[:3, 3])
            transform = self.make(
                "geometry_msgs/Transform",
                translation=self.make("geometry_msgs/Vector3", x=x, y=y, z=z),
                rotation=self._quaternion(T),
            )
            items.append(
                self.make(
                    "geometry_msgs/TransformStamped",
                    header=header,
                    child_frame_id=child,
                    transform=transform,
                )
            )
        return self.make("tf2_msgs/TFMessage", transforms=items)

    def sensor_poses(self, stamp_ns: int, T_vehicle_sensor: Mapping[str, Float[np.ndarray, "4 4"]]) -> Any:
        """TFMessage with the vehicle as the parent of every sensor."""
        poses = T_vehicle_sensor.items()
        return self.transforms((self.at(stamp_ns, "base"), frame_of(name), T) for name, T in poses)

    def odometry(
        self, stamp_ns: int, T_odom_vehicle: Float[np.ndarray, "4 4"], speed_mps: float, yaw_rate_radps: float
    ) -> Any:
        """Odometry: pose in the frame odom, twist (forward speed and yaw rate) in the vehicle frame."""
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        linear = self.make("geometry_msgs/Vector3", **(zero | {"x": speed_mps}))
        angular = self.make("geometry_msgs/Vector3", **(zero | {"z": yaw_rate_radps}))
        twist = self.make("geometry_msgs/Twist", linear=linear, angular=angular)
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(stamp_ns, "odom"),
            child_frame_id=frame_of("base"),
            pose=self.pose(T_odom_vehicle),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def pose(self, T: Float[np.ndarray, "4 4"]) -> Any:
        """PoseWithCovariance with a covariance of zeros (in ROS: unknown)."""
        x, y, z = (float(v) for v in T[:3, 3])
        position = self.make("geometry_msgs/Point", x=x, y=y, z=z)
        pose = self.make("geometry_msgs/Pose", position=position, orientation=self._quaternion(T))
        return self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))

    def _quaternion(self, T: np.ndarray) -> Any:
        w, x, y, z = (float(q) for q in to_quaternion(T))
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


class McapLog:
    """Writer of a ROS 2 MCAP file.

    Args:
        stream: receives the bytes; stays open.
        library: name of the writing program, for the file header.
        compression: of the chunks.
    """

    def __init__(
        self,
        stream: BinaryIO | BufferedIOBase,
        library: str,
        compression: CompressionType = CompressionType.ZSTD,
    ) -> None:
        self.messages = RosMessages(2)
        self.writer = Writer(stream, chunk_size=4 << 20, compression=compression)
        self.writer.start(profile="ros2", library=library)
        self._channels: dict[str, int] = {}

    def put(self, topic: str, stamp_ns: int, message: Any, **metadata: str) -> None:
        """Write a message; the metadata of a topic is that of its first message."""
        if topic not in self._channels:
            kind = message.__msgtype__
            text = self.messages.typestore.generate_msgdef(kind, ros_version=2)[0]
            schema = self.writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            self._channels[topic] = self.writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=schema, metadata=metadata
            )
        data = self.messages.serialised(message)
        self.writer.add_message(self._channels[topic], log_time=stamp_ns, publish_time=stamp_ns, data=data)


def register(store: Typestore, msgtype: str) -> None:
    """Add one type of DEFINITIONS and the types it needs."""
    for name in (*DEFINITIONS[msgtype][0], msgtype):
        store.register(get_types_from_msg(DEFINITIONS[name][1], name))
