"""Conversion of Foxglove's messages to the corresponding ROS messages, so that one reader serves both.

Supported are Foxglove's schemas with a counterpart in ROS; they come as protobuf (`foxglove.PointCloud`) and
as ROS 2 messages (`foxglove_msgs/msg/PointCloud`). CompressedImage and CompressedVideo need no conversion.
Source: foxglove-sdk, schemas/proto/foxglove; sensor_msgs, geometry_msgs, nav_msgs.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

__all__ = ["REFUSED", "as_ros", "foxglove_types"]

# Foxglove's PackedElementField.NumericType -> sensor_msgs/PointField's datatype: signed and unsigned are
# swapped.
_DATATYPE = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
_POSE_TOLERANCE = 1e-9  # tolerance for an identity pose stored as float32 or decimal text
# Unusable types with the reason, reported if a topic of the rig has one.
REFUSED = {
    "LaserScan": "it has no Doppler, without which no radar can be calibrated: log the radar as a PointCloud",
    "CompressedPointCloud": "its compression is not read: log the points as a PointCloud",
    "SceneUpdate": "it has no boxes in the image: log 2D detections",
    "ImageAnnotations": "its annotations have no classes: log 2D detections",
}


def foxglove_types(*kinds: str) -> tuple[str, ...]:
    """Names of message types in their protobuf and ROS 2 forms."""
    return (*(f"foxglove.{k}" for k in kinds), *(f"foxglove_msgs/msg/{k}" for k in kinds))


def as_ros(msgtype: str, message: Any) -> Any:
    """A Foxglove message with the attributes of its ROS counterpart; other messages unchanged.

    Raises:
        ValueError: a cloud with a pose other than identity, or without the size of its points.
    """
    package, _, kind = msgtype.replace("/msg/", ".").rpartition(".")
    twin = _TWINS.get(kind) if package in {"foxglove", "foxglove_msgs"} else None
    return message if twin is None else twin(message)


def _raw_image(message: Any) -> Any:
    fields = {name: getattr(message, name) for name in ("width", "height", "encoding", "step")}
    return SimpleNamespace(**fields, is_bigendian=0, data=np.frombuffer(message.data, np.uint8))


def _point_cloud(message: Any) -> Any:
    if not _is_identity(message.pose):
        raise ValueError(
            "the cloud has a pose in its frame: give the sensor a frame of its own, so that frame_id is the sensor's"
        )
    stride, data = int(message.point_stride), np.frombuffer(message.data, np.uint8)
    if stride < 1:
        raise ValueError("the cloud has point_stride 0")
    fields = [
        SimpleNamespace(name=f.name, offset=f.offset, count=1, datatype=_DATATYPE.get(int(f.type), 0))
        for f in message.fields
    ]
    width = len(data) // stride
    layout = {"height": 1, "width": width, "point_step": stride, "row_step": width * stride}
    return SimpleNamespace(**layout, fields=fields, is_bigendian=False, data=data)


def _camera_calibration(message: Any) -> Any:
    """Foxglove leaves K empty and ROS writes zeros for a camera that is not calibrated."""
    K, D = _upper(message, "K"), _upper(message, "D")
    fields = {name: getattr(message, name) for name in ("distortion_model", "width", "height")}
    return SimpleNamespace(K=K if len(K) else np.zeros(9), D=D, **fields)


def _upper(message: Any, name: str) -> Any:
    """Value of a field that protobuf names in upper case and ROS 2 in lower case."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())


def _frame_transforms(message: Any) -> Any:
    """Of several transforms, or of one."""
    return SimpleNamespace(transforms=[_stamped(t) for t in getattr(message, "transforms", [message])])


def _stamped(transform: Any) -> Any:
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=transform.parent_frame_id),
        child_frame_id=transform.child_frame_id,
        transform=SimpleNamespace(translation=transform.translation, rotation=transform.rotation),
    )


def _odometry(message: Any) -> Any:
    """In both, velocities are those of the body in its own frame."""
    twist = SimpleNamespace(linear=message.linear_velocity, angular=message.angular_velocity)
    return SimpleNamespace(
        child_frame_id=message.body_frame_id,
        pose=SimpleNamespace(pose=message.pose),
        twist=SimpleNamespace(twist=twist),
    )


def _is_identity(pose: Any) -> bool:
    """Whether a pose is the identity, or unset (all zeros)."""
    p, q = pose.position, pose.orientation
    return max(abs(v) for v in (p.x, p.y, p.z, q.x, q.y, q.z)) < _POSE_TOLERANCE


_TWINS: dict[str, Callable[[Any], Any]] = {
    "RawImage": _raw_image,
    "PointCloud": _point_cloud,
    "CameraCalibration": _camera_calibration,
    "FrameTransform": _frame_transforms,
    "FrameTransforms": _frame_transforms,
    "Odometry": _odometry,
}
