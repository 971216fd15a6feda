"""ROS messages of one typestore (ROS 1 or ROS 2), filled from plain arrays."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.geometry.cameras import Camera
from pipeline.rig.topics import frame_of
from pipeline.ros_messages import RosMessages
from pipeline.simulate.sensors.semantics import Box

__all__ = ["Messages"]

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


@lru_cache(maxsize=2)
def _typestore(ros_version: int) -> Any:
    """All types that the logs need; compiled once per process."""
    store = get_typestore(Stores.ROS1_NOETIC if ros_version == 1 else Stores.ROS2_HUMBLE)
    for name, text in (_VISION | _TFMESSAGE).items():
        if name not in store.types:
            store.register(get_types_from_msg(text, name))
    return store


class Messages:
    """Makes messages of ROS version 1 or 2, in the frames of the simulated car; sensors go by their names."""

    def __init__(self, ros_version: int) -> None:
        self.typestore = _typestore(ros_version)
        self.ros = RosMessages(self.typestore, ros_version)

    def serialised(self, message: Any) -> bytes:
        """Wire bytes."""
        return self.ros.serialised(message)

    def _at(self, stamp_ns: int, frame: str) -> Any:
        return self.ros.header(stamp_ns, frame_of(frame))

    def image(self, stamp_ns: int, camera: str, data: bytes, encoding: str) -> Any:
        """CompressedImage."""
        return self.ros.image(self._at(stamp_ns, camera), data, encoding)

    def camera_info(self, stamp_ns: int, camera: str, intrinsics: Camera) -> Any:
        """CameraInfo."""
        return self.ros.camera_info(self._at(stamp_ns, camera), intrinsics)

    def cloud(self, stamp_ns: int, sensor: str, columns: dict[str, np.ndarray]) -> Any:
        """PointCloud2 of float32 and uint16 columns, packed in their order."""
        return self.ros.cloud(self._at(stamp_ns, sensor), columns)

    def detections(self, stamp_ns: int, camera: str, boxes: list[Box]) -> Any:
        """Detection2DArray; boxes in full-image pixels."""
        items = []
        for i, box in enumerate(boxes):
            hypothesis = self.ros.make("vision_msgs/ObjectHypothesis", class_id=box.name, score=box.score)
            pose = self.ros.pose(np.eye(4), with_covariance=True)
            result = self.ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose)
            middle = self.ros.make("vision_msgs/Point2D", x=(box.x0 + box.x1) / 2, y=(box.y0 + box.y1) / 2)
            centre = self.ros.make("vision_msgs/Pose2D", position=middle, theta=0.0)
            bbox = self.ros.make(
                "vision_msgs/BoundingBox2D", center=centre, size_x=box.x1 - box.x0, size_y=box.y1 - box.y0
            )
            header = self._at(stamp_ns, camera)
            items.append(
                self.ros.make(
                    "vision_msgs/Detection2D", header=header, results=[result], bbox=bbox, id=str(i)
                )
            )
        return self.ros.make(
            "vision_msgs/Detection2DArray", header=self._at(stamp_ns, camera), detections=items
        )

    def transforms(self, stamp_ns: int, T_vehicle_sensor: dict[str, Float[np.ndarray, "4 4"]]) -> Any:
        """TFMessage with the vehicle as parent of every sensor."""
        poses = T_vehicle_sensor.items()
        return self.ros.transforms((self._at(stamp_ns, "base"), frame_of(s), T) for s, T in poses)

    def odometry(
        self, stamp_ns: int, T_odom_vehicle: Float[np.ndarray, "4 4"], speed_mps: float, yaw_rate_radps: float
    ) -> Any:
        """Odometry: pose in odom, twist in the vehicle frame."""
        header = self.ros.header(stamp_ns, "odom")
        return self.ros.odometry(header, frame_of("base"), T_odom_vehicle, speed_mps, yaw_rate_radps)
