"""ROS messages filled from plain arrays: what the simulator, `convert` and `export` write into logs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import to_quaternion

__all__ = ["RosMessages"]

_DATATYPES: Final = {"f4": 7, "u2": 4, "u1": 2}  # sensor_msgs/PointField


class RosMessages:
    """Makes messages of one typestore of rosbags, and their wire bytes.

    Args:
        typestore: of ROS 1 or ROS 2; it holds tf2_msgs where transforms are made.
        ros_version: 1 or 2.
    """

    def __init__(self, typestore: Any, ros_version: int) -> None:
        self.typestore, self.ros_version = typestore, ros_version

    def make(self, name: str, /, **fields: Any) -> Any:
        """A message of a type; name as "sensor_msgs/PointCloud2"."""
        package, short = name.split("/")
        return self.typestore.types[f"{package}/msg/{short}"](**fields)

    def serialised(self, message: Any) -> bytes:
        """Wire bytes."""
        pack = self.typestore.serialize_ros1 if self.ros_version == 1 else self.typestore.serialize_cdr
        return bytes(pack(message, message.__msgtype__))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Header."""
        time = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 0} if self.ros_version == 1 else {}
        return self.make("std_msgs/Header", stamp=time, frame_id=frame_id, **seq)

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
            "sensor_msgs/CameraInfo",
            header=header,
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=camera.model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **dict(zip(names, values, strict=True)),
        )

    def cloud(self, header: Any, columns: Mapping[str, np.ndarray]) -> Any:
        """PointCloud2 of columns of float32, uint16 and uint8 (N each), packed in their order."""
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
            "sensor_msgs/PointCloud2",
            header=header,
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(rows),
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=True,
        )

    def transforms(self, of_child: Iterable[tuple[Any, str, Float[np.ndarray, "4 4"]]]) -> Any:
        """TFMessage of (header that names the parent, child frame, T_parent_child)."""
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

    def odometry(
        self,
        header: Any,
        child: str,
        T_odom_vehicle: Float[np.ndarray, "4 4"],
        speed_mps: float,
        yaw_rate_radps: float,
    ) -> Any:
        """Odometry: pose in the header's frame, twist (forward speed and yaw rate) in the child's."""
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        linear = self.make("geometry_msgs/Vector3", **(zero | {"x": speed_mps}))
        angular = self.make("geometry_msgs/Vector3", **(zero | {"z": yaw_rate_radps}))
        twist = self.make("geometry_msgs/Twist", linear=linear, angular=angular)
        return self.make(
            "nav_msgs/Odometry",
            header=header,
            child_frame_id=child,
            pose=self.pose(T_odom_vehicle, with_covariance=True),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def pose(self, T: Float[np.ndarray, "4 4"], *, with_covariance: bool = False) -> Any:
        """Pose, or PoseWithCovariance with a covariance of zeros (unknown, as ROS has it)."""
        x, y, z = (float(v) for v in T[:3, 3])
        position = self.make("geometry_msgs/Point", x=x, y=y, z=z)
        pose = self.make("geometry_msgs/Pose", position=position, orientation=self._quaternion(T))
        if not with_covariance:
            return pose
        return self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))

    def _quaternion(self, T: np.ndarray) -> Any:
        w, x, y, z = (float(q) for q in to_quaternion(T))
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
