"""ROS messages of one typestore (ROS 1 or ROS 2), filled from plain arrays."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import to_quaternion
from pipeline.simulate.sensors.semantics import Box

__all__ = ["FRAMES", "Messages"]

FRAMES: Final = {
    "camera": "camera_front_optical",
    "lidar": "lidar_top",
    "radar": "radar_front",
    "vehicle": "base_link",
}
# vision_msgs 4 (ROS 2 Humble), as the real logs carry it; rosbags ships no vision_msgs.
_VISION: Final = {
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}
_TFMESSAGE: Final = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms"}
_FLOAT32, _UINT16 = 7, 4


@lru_cache(maxsize=2)
def _typestore(ros_version: int) -> Any:
    """All types that the logs need; compiled once per process."""
    store = get_typestore(Stores.ROS1_NOETIC if ros_version == 1 else Stores.ROS2_HUMBLE)
    for name, text in (_VISION | _TFMESSAGE).items():
        if name not in store.types:
            store.register(get_types_from_msg(text, name))
    return store


class Messages:
    """Makes messages of ROS version 1 or 2."""

    def __init__(self, ros_version: int) -> None:
        self.ros_version = ros_version
        self.typestore = _typestore(ros_version)

    def make(self, name: str, /, **fields: Any) -> Any:
        """A message of a type; name as "sensor_msgs/PointCloud2"."""
        package, short = name.split("/")
        return self.typestore.types[f"{package}/msg/{short}"](**fields)

    def serialised(self, message: Any) -> bytes:
        """Wire bytes."""
        pack = self.typestore.serialize_ros1 if self.ros_version == 1 else self.typestore.serialize_cdr
        return bytes(pack(message, message.__msgtype__))

    def _header(self, stamp_ns: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 0} if self.ros_version == 1 else {}
        return self.make("std_msgs/Header", stamp=time, frame_id=FRAMES[frame], **seq)

    def image(self, stamp_ns: int, data: bytes, encoding: str) -> Any:
        """CompressedImage."""
        return self.make(
            "sensor_msgs/CompressedImage",
            header=self._header(stamp_ns, "camera"),
            format=encoding,
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(self, stamp_ns: int, camera: Camera) -> Any:
        """CameraInfo."""
        roi = self.make(
            "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        P = np.zeros((3, 4))
        P[:, :3] = camera.K
        names = ("D", "K", "R", "P") if self.ros_version == 1 else ("d", "k", "r", "p")
        values = (
            np.asarray(camera.D, np.float64),
            camera.K.ravel().astype(np.float64),
            np.eye(3).ravel(),
            P.ravel(),
        )
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self._header(stamp_ns, "camera"),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=camera.model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **dict(zip(names, values, strict=True)),
        )

    def cloud(self, stamp_ns: int, frame: str, columns: dict[str, np.ndarray]) -> Any:
        """PointCloud2 of float32 and uint16 columns, packed in their order."""
        dtype = np.dtype([(name, c.dtype.newbyteorder("<")) for name, c in columns.items()])
        rows = np.empty(len(next(iter(columns.values()))), dtype)
        fields, offset = [], 0
        for name, c in columns.items():
            rows[name] = c
            kind = {"f": _FLOAT32, "u": _UINT16}[c.dtype.kind]
            fields.append(
                self.make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)
            )
            offset += c.dtype.itemsize
        return self.make(
            "sensor_msgs/PointCloud2",
            header=self._header(stamp_ns, frame),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(rows),
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=True,
        )

    def detections(self, stamp_ns: int, boxes: list[Box]) -> Any:
        """Detection2DArray; boxes in full-image pixels."""
        items = []
        for i, box in enumerate(boxes):
            hypothesis = self.make("vision_msgs/ObjectHypothesis", class_id=box.name, score=box.score)
            pose = self.make(
                "geometry_msgs/PoseWithCovariance", pose=self._pose(np.eye(4)), covariance=np.zeros(36)
            )
            result = self.make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose)
            middle = self.make("vision_msgs/Point2D", x=(box.x0 + box.x1) / 2, y=(box.y0 + box.y1) / 2)
            centre = self.make("vision_msgs/Pose2D", position=middle, theta=0.0)
            bbox = self.make(
                "vision_msgs/BoundingBox2D", center=centre, size_x=box.x1 - box.x0, size_y=box.y1 - box.y0
            )
            header = self._header(stamp_ns, "camera")
            items.append(
                self.make("vision_msgs/Detection2D", header=header, results=[result], bbox=bbox, id=str(i))
            )
        return self.make(
            "vision_msgs/Detection2DArray", header=self._header(stamp_ns, "camera"), detections=items
        )

    def transforms(self, stamp_ns: int, T_vehicle_sensor: dict[str, Float[np.ndarray, "4 4"]]) -> Any:
        """TFMessage with the vehicle as parent of every sensor."""
        items = []
        for sensor, T in T_vehicle_sensor.items():
            pose = self._pose(T)
            t = self.make("geometry_msgs/Vector3", x=pose.position.x, y=pose.position.y, z=pose.position.z)
            transform = self.make("geometry_msgs/Transform", translation=t, rotation=pose.orientation)
            header = self._header(stamp_ns, "vehicle")
            items.append(
                self.make(
                    "geometry_msgs/TransformStamped",
                    header=header,
                    child_frame_id=FRAMES[sensor],
                    transform=transform,
                )
            )
        return self.make("tf2_msgs/TFMessage", transforms=items)

    def odometry(
        self, stamp_ns: int, T_odom_vehicle: Float[np.ndarray, "4 4"], speed_mps: float, yaw_rate_radps: float
    ) -> Any:
        """Odometry: pose in odom, twist in the vehicle frame."""
        header = self._header(stamp_ns, "vehicle")
        header.frame_id = "odom"
        o = {"x": 0.0, "y": 0.0, "z": 0.0}
        linear = self.make("geometry_msgs/Vector3", **(o | {"x": speed_mps}))
        angular = self.make("geometry_msgs/Vector3", **(o | {"z": yaw_rate_radps}))
        twist = self.make("geometry_msgs/Twist", linear=linear, angular=angular)
        return self.make(
            "nav_msgs/Odometry",
            header=header,
            child_frame_id=FRAMES["vehicle"],
            pose=self.make(
                "geometry_msgs/PoseWithCovariance", pose=self._pose(T_odom_vehicle), covariance=np.zeros(36)
            ),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def _pose(self, T: np.ndarray) -> Any:
        w, x, y, z = (float(q) for q in to_quaternion(T))
        position = self.make("geometry_msgs/Point", x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
        return self.make(
            "geometry_msgs/Pose",
            position=position,
            orientation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
        )
