"""The drives of `written_logs` in Foxglove's schemas: message by message, by the official protobuf classes."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import mcap.writer
from mcap.reader import make_reader
from mcap_protobuf.schema import build_file_descriptor_set

from tests.makers.written_logs import Kit

# sensor_msgs/PointField's datatype -> PackedElementField.NumericType
_NUMBERS = ("", "INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64")


def schema(name: str) -> Any:
    """The official class of a message."""
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def messages_of(path: Path) -> dict[str, list[Any]]:
    """By topic, the messages of an MCAP: by the official classes, not by the schemas in the file."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for its, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            if its is not None and its.encoding == "protobuf":
                whole = schema(its.name.removeprefix("foxglove."))
                assert its.name == whole.DESCRIPTOR.full_name
                told = whole.FromString(message.data)
            else:
                told = json.loads(message.data)
            found.setdefault(channel.topic, []).append(told)
    return found


def foxglove(message: Any) -> Any:
    """A ROS message as Foxglove's; the message itself where Foxglove has no such."""
    kind = message.__msgtype__.rpartition("/")[2]
    translated = _TRANSLATED.get(kind)
    return message if translated is None else translated(message)


def write(kit: Kit, path: Path, translate: Any = foxglove) -> Path:
    """The kit's messages as an MCAP, those that Foxglove has schemas of in protobuf, the others in CDR."""
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, chunk_size=40_000)
        writer.start(library="test")
        channels: dict[tuple[str, str], int] = {}
        for topic, kind, log_time, message in kit.messages:
            said = translate(message)
            if hasattr(said, "__msgtype__"):
                name, encodings = kind, ("ros2msg", "cdr")
                data = bytes(kit.store.serialize_cdr(said, kind))
            else:
                name, encodings, data = said.DESCRIPTOR.full_name, ("protobuf",) * 2, said.SerializeToString()
            if (topic, name) not in channels:
                is_ros = encodings[1] == "cdr"
                text = (
                    kit.store.generate_msgdef(kind, ros_version=2)[0].encode()
                    if is_ros
                    else descriptors(said)
                )
                number = writer.register_schema(name, encodings[0], text)
                channels[topic, name] = writer.register_channel(topic, encodings[1], number)
            writer.add_message(channels[topic, name], log_time, data, log_time)
        writer.finish()
    return path


def descriptors(message: Any) -> bytes:
    """A message's schema as an MCAP carries it."""
    return build_file_descriptor_set(type(message)).SerializeToString()


def _new(name: str, header: Any, **fields: Any) -> Any:
    made = schema(name)(**fields)
    made.timestamp.seconds, made.timestamp.nanos = header.stamp.sec, header.stamp.nanosec
    if hasattr(made, "frame_id"):
        made.frame_id = header.frame_id
    return made


def _compressed(m: Any) -> Any:
    return _new("CompressedImage", m.header, data=m.data.tobytes(), format=m.format)


def _image(m: Any) -> Any:
    same = {name: getattr(m, name) for name in ("width", "height", "encoding", "step")}
    return _new("RawImage", m.header, **same, data=m.data.tobytes())


def _info(m: Any) -> Any:
    same = {name: getattr(m, name) for name in ("width", "height", "distortion_model")}
    return _new("CameraCalibration", m.header, **same, D=m.d, K=m.k if m.k.any() else [], R=m.r, P=m.p)


def _cloud(m: Any) -> Any:
    element = schema("PackedElementField")
    fields = [element(name=f.name, offset=f.offset, type=_NUMBERS[f.datatype]) for f in m.fields]
    data = {"point_stride": m.point_step, "data": m.data.tobytes()}
    cloud = _new("PointCloud", m.header, fields=fields, **data)
    cloud.pose.orientation.w = 1.0
    return cloud


def _transforms(m: Any) -> Any:
    return schema("FrameTransforms")(transforms=[transform(t) for t in m.transforms])


def transform(t: Any) -> Any:
    made = _new(
        "FrameTransform", t.header, parent_frame_id=t.header.frame_id, child_frame_id=t.child_frame_id
    )
    _copy(made.translation, t.transform.translation, "xyz")
    _copy(made.rotation, t.transform.rotation, "xyzw")
    return made


def _odometry(m: Any) -> Any:
    made = _new("Odometry", m.header, body_frame_id=m.child_frame_id)
    _copy(made.pose.position, m.pose.pose.position, "xyz")
    _copy(made.pose.orientation, m.pose.pose.orientation, "xyzw")
    _copy(made.linear_velocity, m.twist.twist.linear, "xyz")
    _copy(made.angular_velocity, m.twist.twist.angular, "xyz")
    return made


def _copy(to: Any, of: Any, names: str) -> None:
    for name in names:
        setattr(to, name, getattr(of, name))


_TRANSLATED = {
    "CompressedImage": _compressed, "Image": _image, "CameraInfo": _info, "PointCloud2": _cloud,
    "TFMessage": _transforms, "Odometry": _odometry,
}  # fmt: skip
