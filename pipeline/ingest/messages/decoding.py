"""Decoding of messages: header stamps from raw bytes, whole messages by the schema in the log.

The header at its start shows whether a message's bytes match the ROS generation that its log claims. Both
generations begin with 4 bytes (CDR's encapsulation, ROS 1's sequence number), a stamp and the frame's name.
CDR counts and writes a zero after the name, ROS 1 does not.

Foxglove's messages are converted to the corresponding ROS messages, so that one reader serves both. Supported are
Foxglove's schemas with a counterpart in ROS; they come as protobuf (`foxglove.PointCloud`) and as ROS 2 messages
(`foxglove_msgs/msg/PointCloud`). CompressedImage and CompressedVideo need no conversion.
Source: foxglove-sdk, schemas/proto/foxglove; sensor_msgs, geometry_msgs, nav_msgs.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.core.errors import LogError
from pipeline.core.ros_messages import DEFINITIONS, register
from pipeline.ingest.containers.reader import BYTES_AS_TEXT, PROTOBUF, READ_ERRORS, Channel

__all__ = [
    "DECODE_ERRORS", "REFUSED", "as_ros", "content_without_stamp", "decode", "encoding_fault",
    "foxglove_types", "header_frame_id", "header_stamp_ns",
]  # fmt: skip

# For malformed bytes, errors of `decode` and of the functions that read a decoded message.
DECODE_ERRORS = (
    LogError, *READ_ERRORS, SerdeError, TypesysError, TypeError, AttributeError, MemoryError,
)  # fmt: skip
# CDR: 4 bytes of encapsulation, seconds, nanoseconds; ROS 1: sequence number, seconds, nanoseconds.
_STAMP_END = 12
_LAST_S = 2**33  # beyond it nanoseconds overflow int64: a damaged number
_SEPARATOR = "=" * 80 + "\n"
_WRITTEN_BY = {"cdr": "ROS 2", "ros1": "ROS 1"}
_NAME = 16  # offset of the frame's name; its length is in the 4 bytes before
_LONGEST_NAME = 1024


def header_stamp_ns(channel: Channel, data: memoryview) -> int | None:
    """Stamp of a message that starts with a std_msgs/Header; None if it is truncated, zero or invalid.

    Foxglove's ROS 2 messages start with the same bytes; for a protobuf message it is the `timestamp`.
    """
    if channel.encoding == PROTOBUF:
        try:
            stamp = _parsed(channel, data).timestamp
            seconds, nanoseconds = int(stamp.seconds), int(stamp.nanos)
        except (ValueError, AttributeError):
            return None
    elif len(data) < _STAMP_END:
        return None
    else:
        seconds, nanoseconds = struct.unpack_from(_order(channel, data) + "iI", data, 4)
    is_time = 0 <= seconds < _LAST_S and 0 <= nanoseconds < 10**9 and seconds + nanoseconds > 0
    return seconds * 10**9 + nanoseconds if is_time else None


def header_frame_id(channel: Channel, data: memoryview) -> str:
    """Frame id of such a message, without ROS 1's leading slash; "" if there is none."""
    if channel.encoding == PROTOBUF:
        return str(getattr(_parsed(channel, data), "frame_id", "")).lstrip("/")
    if len(data) < _NAME:
        return ""
    length = struct.unpack_from(_order(channel, data) + "I", data, _NAME - 4)[0]
    raw = bytes(data[_NAME : _NAME + min(length, _LONGEST_NAME)])
    return raw.rstrip(b"\0").decode(errors="replace").lstrip("/")


def content_without_stamp(channel: Channel, data: memoryview) -> bytes:
    """Bytes that are equal for messages that differ only in stamp and sequence number."""
    if channel.encoding == PROTOBUF:
        message = _parsed(channel, data)
        message.ClearField("timestamp")
        return bytes(message.SerializeToString(deterministic=True))
    return bytes(data[_STAMP_END:])


def decode(channel: Channel, data: memoryview) -> Any:
    """Decode a message by its embedded definition; arrays are views into `data`.

    Foxglove's messages get the attributes of the corresponding ROS messages.

    Raises:
        LogError: no definition, neither CDR, ROS 1 nor protobuf, or bytes that do not fit the definition.
    """
    try:
        if channel.encoding == PROTOBUF:
            message = _parsed(channel, data)
        elif channel.encoding == "ros1":
            message = _typestore(channel).deserialize_ros1(data, channel.msgtype)
        else:
            message = _typestore(channel).deserialize_cdr(data, channel.msgtype)
        return as_ros(channel.msgtype, message)
    except DECODE_ERRORS as err:
        raise LogError(
            "", f"{channel.msgtype} cannot be decoded: {type(err).__name__}: {err}", topic=channel.topic
        ) from err


def _parsed(channel: Channel, data: memoryview) -> Any:
    """A protobuf message by the schema in the MCAP; raises ValueError if schema or bytes are invalid."""
    from google.protobuf.message import DecodeError  # noqa: PLC0415  # logs of ROS alone need no protobuf

    try:
        return _protobuf_decoder(channel)(bytes(data))
    except DecodeError as err:
        raise ValueError(f"bytes do not fit the schema: {err}") from err


@lru_cache(maxsize=64)
def _protobuf_decoder(channel: Channel) -> Callable[[bytes], Any]:
    from mcap.exceptions import McapError  # noqa: PLC0415
    from mcap.records import Schema  # noqa: PLC0415
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415

    schema = Schema(1, channel.definition.encode(BYTES_AS_TEXT), channel.definition_format, channel.msgtype)
    try:
        decoder = DecoderFactory().decoder_for(PROTOBUF, schema)
    except (McapError, TypeError, KeyError) as err:
        raise ValueError(f"the log's schema of it cannot be used: {err}") from err
    if decoder is None:
        raise ValueError("the log carries no protobuf schema of it")
    return decoder


def _order(channel: Channel, data: memoryview) -> str:
    return "<" if channel.encoding == "ros1" or data[1] & 1 else ">"


@lru_cache(maxsize=64)
def _typestore(channel: Channel) -> Typestore:
    if channel.encoding not in {"cdr", "ros1"}:
        raise ValueError(f"encoding {channel.encoding!r} is neither cdr, ros1 nor protobuf")
    if not channel.definition:
        return _fallback(channel.msgtype)
    store = get_typestore(Stores.EMPTY)
    if channel.definition_format == "msg":
        types = get_types_from_msg(channel.definition, channel.msgtype)
    elif channel.definition.startswith(f"{_SEPARATOR}IDL: "):
        types = {}
        for part in channel.definition.split(_SEPARATOR)[1:]:
            types.update(get_types_from_idl(part.split("\n", 1)[1]))
    else:
        types = get_types_from_idl(channel.definition)
    store.register(types)
    return store


@lru_cache(maxsize=8)
def _fallback(msgtype: str) -> Typestore:
    """Definitions of the ROS 2 distribution, for bags up to Humble, which contain none."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    if msgtype in DEFINITIONS:
        register(store, msgtype)
    elif msgtype not in store.fielddefs:
        raise ValueError(
            "the log carries no definition of it: record with ROS 2 Iron or newer, or convert the bag to MCAP"
        )
    return store


def encoding_fault(channel: Channel, data: memoryview) -> str:
    """Reason why a message with a header is not in its log's encoding, and the remedy; else empty."""
    said = channel.encoding
    if said == PROTOBUF:
        return ""
    if said not in _WRITTEN_BY:
        return f"is logged as {said!r}, which is none of cdr, ros1 and protobuf: record or convert it as one of these"
    found = _written_as(data)
    if found in ("", said):
        return ""
    return (
        f"is logged as {said} ({_WRITTEN_BY[said]}), but its bytes are {found} ({_WRITTEN_BY[found]}): convert the "
        f"original .bag or .db3 again, with `mcap convert`"
    )


def _written_as(data: memoryview) -> str:
    """Encoding of the header at the start of a message; empty if undetermined."""
    if len(data) < _NAME:
        return ""
    for order, encoding in (("<", "ros1"), ("<" if data[1] & 1 else ">", "cdr")):
        length = struct.unpack_from(f"{order}I", data, _NAME - 4)[0]
        name = bytes(data[_NAME : _NAME + min(length, _LONGEST_NAME)])
        if len(name) != length or not length:
            continue
        is_ended = name.endswith(b"\0")
        text = name[: length - is_ended].decode("latin-1")
        if is_ended == (encoding == "cdr") and text.isascii() and text.isprintable():
            return encoding
    return ""


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
