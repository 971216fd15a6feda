"""Faults put into recorded logs: every message of a day is copied, and an edit changes those of one topic on the way.

An edit is what goes wrong on a car: a stamp, a unit, a sign, a calibration file, a turned sensor. Logs that went
through it are read by `ingest` like any others, so nothing of the product is left out. Two containers are read (MCAP
and ROS 2 bags, whose messages are CDR); what is written is MCAP.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.geometry.se3 import exp_so3, from_quaternion, from_rotation_translation, to_quaternion
from pipeline.ingest.containers.reader import open_log

__all__ = ["EDITS", "Edit", "Place", "rewrite_logs"]

_STORE = get_typestore(Stores.ROS2_HUMBLE)
_STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
_CODES = {
    1: "i1",
    2: "u1",
    3: "<i2",
    4: "<u2",
    5: "<i4",
    6: "<u4",
    7: "<f4",
    8: "<f8",
}  # sensor_msgs/PointField


@dataclass(frozen=True)
class Place:
    """Where in the day a message lies."""

    number: int  # of its topic, from 0
    share: float  # of the topic's messages that lie before it, 0 to 1
    frame: str  # frame id of the sensor that the fault is about


# (message, amount, place) -> message, or None where it is left out.
Change = Callable[[Any, float, Place], Any]


@dataclass(frozen=True)
class Edit:
    """What is done to the messages of some roles: image, info, labels, detections, lidar, radar, odometry, tf."""

    roles: tuple[str, ...]
    change: Change
    raw: bool = False  # gets and returns wire bytes


def rewrite_logs(
    logs: Sequence[Path], out: Path, roles: Mapping[str, str], edit: Edit | None, amount: float, frame: str
) -> list[Path]:
    """Copy logs as MCAP with an edit.

    Args:
        logs: CDR logs of one vehicle-day in order of time.
        out: folder for the copies.
        roles: topic of each role.
        edit: what goes wrong; None copies.
        amount: its size.
        frame: frame id of the sensor that it is about.
    """
    edited = {roles[role] for role in (edit.roles if edit else ()) if role in roles}
    count = dict.fromkeys(edited, 0)
    for log in logs:
        reader = open_log(log)
        for raw in reader.scan(edited):
            count[raw.channel.topic] += 1
        reader.close()
    number, held, paths = dict.fromkeys(edited, 0), dict[str, Any](), []
    for k, log in enumerate(logs):
        paths.append(out / f"{k:02d}.mcap")
        _copy(log, paths[-1], edit, amount, frame, count, number, held)
    return paths


def _copy(
    log: Path,
    path: Path,
    edit: Edit | None,
    amount: float,
    frame: str,
    count: Mapping[str, int],
    number: dict[str, int],
    held: dict[str, Any],
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    reader = open_log(log)
    channels = dict[str, int]()
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4 << 20, compression=CompressionType.LZ4)
        writer.start(profile="ros2", library="boresight-study")
        for raw in reader.scan():
            channel, data = raw.channel, bytes(raw.data)
            if edit is not None and channel.topic in count:
                n = number[channel.topic]
                number[channel.topic] += 1
                place = Place(n, n / max(1, count[channel.topic]), frame)
                changed = _changed(
                    edit, data, channel.msgtype, amount, place, held.setdefault(channel.topic, {})
                )
                if changed is None:
                    continue
                data = changed
            if channel.topic not in channels:
                schema = writer.register_schema(
                    name=channel.msgtype, encoding="ros2msg", data=channel.definition.encode()
                )
                channels[channel.topic] = writer.register_channel(
                    topic=channel.topic, message_encoding=channel.encoding, schema_id=schema
                )
            at = raw.log_time_ns
            writer.add_message(channels[channel.topic], log_time=at, publish_time=at, data=data)
        writer.finish()
    reader.close()


def _changed(
    edit: Edit, data: bytes, kind: str, amount: float, place: Place, held: dict[str, Any]
) -> bytes | None:
    if edit.raw:
        return edit.change((data, held), amount, place)
    message = _STORE.deserialize_cdr(data, kind)
    message = edit.change(message, amount, place)
    return None if message is None else bytes(_STORE.serialize_cdr(message, kind))


# Clouds


def _cloud(change: Callable[[np.ndarray, float, Place], np.ndarray | None]) -> Change:
    """An edit of the rows of a PointCloud2, as a structured array."""

    def edit(message: Any, amount: float, place: Place) -> Any:
        names = [f.name for f in message.fields]
        dtype = np.dtype(
            {
                "names": names,
                "formats": [_CODES[f.datatype] for f in message.fields],
                "offsets": [f.offset for f in message.fields],
                "itemsize": message.point_step,
            }
        )
        rows = np.frombuffer(message.data.tobytes(), dtype).copy()
        rows = change(rows, amount, place)
        if rows is None:
            return None
        message.height, message.width, message.row_step = 1, len(rows), message.point_step * len(rows)
        message.data = np.frombuffer(rows.tobytes(), np.uint8)
        return message

    return edit


def _xyz(change: Callable[[np.ndarray, float, Place], np.ndarray]) -> Change:
    """An edit of the points' coordinates (N 3)."""

    def edit(rows: np.ndarray, amount: float, place: Place) -> np.ndarray:
        xyz = np.stack([rows["x"], rows["y"], rows["z"]], 1).astype(np.float64)
        for name, values in zip("xyz", change(xyz, amount, place).T, strict=True):
            rows[name] = values
        return rows

    return _cloud(edit)


def _turn(axis: int, after: float) -> Callable[[np.ndarray, float, Place], np.ndarray]:
    """Points of a sensor that is turned by the amount [deg] about one of its axes after a share of the day."""

    def change(xyz: np.ndarray, deg: float, place: Place) -> np.ndarray:
        if place.share < after:
            return xyz
        turn = np.zeros(3)
        turn[axis] = np.radians(deg)
        # What the turned sensor measures are the same points in its new axes.
        return np.asarray(xyz @ exp_so3(turn))

    return change


def _scaled(xyz: np.ndarray, factor: float, place: Place) -> np.ndarray:
    del place
    return xyz * factor


def _mirrored(xyz: np.ndarray, amount: float, place: Place) -> np.ndarray:
    del amount, place
    return xyz * np.array([1.0, -1.0, 1.0])


def _doppler(rows: np.ndarray, factor: float, place: Place) -> np.ndarray:
    del place
    rows["doppler"] *= factor
    return rows


def _emptied(rows: np.ndarray, after: float, place: Place) -> np.ndarray:
    return rows[:0] if place.share >= after else rows


# Stamps, payloads and whole messages


def _stamped(message: tuple[bytes, dict[str, Any]], by_s: float, place: Place) -> bytes:
    """The stamp of a header, which is what a CDR message of any of our types begins with, moved."""
    del place
    data = message[0]
    sec, nanosec = np.frombuffer(data, "<i4", 1, 4)[0], np.frombuffer(data, "<u4", 1, 8)[0]
    ns = int(sec) * 10**9 + int(nanosec) + round(by_s * 1e9)
    stamp = np.array([ns // 10**9], "<i4").tobytes() + np.array([ns % 10**9], "<u4").tobytes()
    return data[:4] + stamp + data[12:]


def _stuck(message: tuple[bytes, dict[str, Any]], after: float, place: Place) -> bytes:
    """The payload that was current when the sensor stuck, under each message's own stamp."""
    data, held = message
    if place.share < after or "data" not in held:
        held["data"] = data
        return data
    return held["data"][:4] + data[4:12] + held["data"][12:]


def _late(message: tuple[bytes, dict[str, Any]], count: float, place: Place) -> bytes | None:
    """Payloads of `count` messages before, under each message's own stamp."""
    data, held = message
    queue = held.setdefault("queue", [])
    queue.append(data)
    if place.number < int(count):
        return None
    old = queue.pop(0)
    return bytes(old[:4] + data[4:12] + old[12:])


def _silent(message: tuple[bytes, dict[str, Any]], after: float, place: Place) -> bytes | None:
    return None if place.share >= after else message[0]


# Camera


def _image(change: Callable[[np.ndarray, float], np.ndarray]) -> Change:
    """An edit of a label image; written as PNG."""

    def edit(message: Any, amount: float, place: Place) -> Any:
        del place
        pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        message.data = cv2.imencode(".png", change(pixels, amount))[1].ravel()
        return message

    return edit


def _warped(matrix: Callable[[float, int, int], np.ndarray]) -> Change:
    """Labels moved by an affine map of pixels (2 3); what comes in from outside is the border repeated."""

    def change(pixels: np.ndarray, amount: float) -> np.ndarray:
        H, W = pixels.shape[:2]
        return np.asarray(
            cv2.warpAffine(
                pixels, matrix(amount, W, H), (W, H), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
        )

    return _image(change)


def _shift(du: float, dv: float) -> Callable[[float, int, int], np.ndarray]:
    return lambda px, _w, _h: np.array([[1.0, 0.0, du * px], [0.0, 1.0, dv * px]])


def _about_centre(factor: float, W: int, H: int) -> np.ndarray:
    return np.array([[factor, 0.0, (1 - factor) * W / 2], [0.0, factor, (1 - factor) * H / 2]])


def _padded(rows: float, W: int, H: int) -> np.ndarray:
    """As a letterbox whose padding is forgotten: the picture squeezed into the rest."""
    del W
    return np.array([[1.0, 0.0, 0.0], [0.0, (H - rows) / H, rows]])


def _info(change: Callable[[Any, float], None]) -> Change:
    def edit(message: Any, amount: float, place: Place) -> Any:
        del place
        message.k, message.p, message.d = message.k.copy(), message.p.copy(), np.array(message.d, np.float64)
        change(message, amount)
        return message

    return edit


def _focal(message: Any, share: float) -> None:
    for values, of in ((message.k, (0, 4)), (message.p, (0, 5))):
        values[list(of)] *= 1 + share


def _centre(row: int) -> Callable[[Any, float], None]:
    def change(message: Any, px: float) -> None:
        message.k[3 * row + 2] += px
        message.p[4 * row + 2] += px

    return change


def _distortion(message: Any, k1: float) -> None:
    if not len(message.d):
        message.d, message.distortion_model = np.zeros(5), "plumb_bob"
    message.d[0] += k1


# Motion and mounting


def _odometry(linear: float = 1.0, angular: float = 1.0, *, scaled: bool = False) -> Change:
    def edit(message: Any, amount: float, place: Place) -> Any:
        del place
        twist, by = message.twist.twist, amount if scaled else 1.0
        for vector, factor in ((twist.linear, linear * by), (twist.angular, angular)):
            vector.x, vector.y, vector.z = factor * vector.x, factor * vector.y, factor * vector.z
        return message

    return edit


def _mounting(step: Callable[[float], np.ndarray]) -> Change:
    """The sensor's edge of tf_static, composed with a step in the sensor's own axes."""

    def edit(message: Any, amount: float, place: Place) -> Any:
        for edge in message.transforms:
            # The edge to the sensor; where the sensor is the parent, the step is undone on the other side.
            child, parent = edge.child_frame_id == place.frame, edge.header.frame_id == place.frame
            if not (child or parent):
                continue
            q, t = edge.transform.rotation, edge.transform.translation
            T = from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z]))
            T = T @ step(amount) if child else np.linalg.inv(step(amount)) @ T
            q.w, q.x, q.y, q.z = (float(v) for v in to_quaternion(T))
            t.x, t.y, t.z = (float(v) for v in T[:3, 3])
        return message

    return edit


def _moved(axis: int) -> Callable[[float], np.ndarray]:
    return lambda m: from_rotation_translation(np.eye(3), m * np.eye(3)[axis])


def _turned(axis: int) -> Callable[[float], np.ndarray]:
    return lambda deg: from_rotation_translation(exp_so3(np.radians(deg) * np.eye(3)[axis]), np.zeros(3))


_CAMERA = ("image", "info", "labels", "detections")
EDITS: dict[str, Edit] = {
    "labels right": Edit(("labels",), _warped(_shift(1, 0))),
    "labels down": Edit(("labels",), _warped(_shift(0, 1))),
    "labels diagonal": Edit(("labels",), _warped(_shift(0.7, -0.7))),
    "labels scaled": Edit(("labels",), _warped(_about_centre)),
    "labels padded": Edit(("labels",), _warped(_padded)),
    "labels late": Edit(("labels",), _late, raw=True),
    "focal": Edit(("info",), _info(_focal)),
    "centre right": Edit(("info",), _info(_centre(0))),
    "centre down": Edit(("info",), _info(_centre(1))),
    "k1": Edit(("info",), _info(_distortion)),
    "camera stamps": Edit(_CAMERA, _stamped, raw=True),
    "camera stuck": Edit(("image", "labels", "detections"), _stuck, raw=True),
    "camera silent": Edit(_CAMERA, _silent, raw=True),
    "labels silent": Edit(("labels",), _silent, raw=True),
    "lidar scaled": Edit(("lidar",), _xyz(_scaled)),
    "lidar mirrored": Edit(("lidar",), _xyz(_mirrored)),
    "lidar stuck": Edit(("lidar",), _stuck, raw=True),
    "lidar stamps": Edit(("lidar",), _stamped, raw=True),
    "lidar silent": Edit(("lidar",), _silent, raw=True),
    "lidar yaw at noon": Edit(("lidar",), _xyz(_turn(2, 0.5))),
    "lidar pitch late": Edit(("lidar",), _xyz(_turn(1, 0.67))),
    "lidar roll at noon": Edit(("lidar",), _xyz(_turn(0, 0.5))),
    "lidar backwards": Edit(("lidar",), _xyz(_turn(2, 0.0))),
    "lidar prior x": Edit(("tf",), _mounting(_moved(0))),
    "lidar prior z": Edit(("tf",), _mounting(_moved(2))),
    "lidar prior yaw": Edit(("tf",), _mounting(_turned(2))),
    "radar scaled": Edit(("radar",), _xyz(_scaled)),
    "radar mirrored": Edit(("radar",), _xyz(_mirrored)),
    "radar stuck": Edit(("radar",), _stuck, raw=True),
    "radar stamps": Edit(("radar",), _stamped, raw=True),
    "radar silent": Edit(("radar",), _silent, raw=True),
    "radar empty": Edit(("radar",), _cloud(_emptied)),
    "radar yaw at noon": Edit(("radar",), _xyz(_turn(2, 0.5))),
    "radar backwards": Edit(("radar",), _xyz(_turn(2, 0.0))),
    "radar prior x": Edit(("tf",), _mounting(_moved(0))),
    "radar prior yaw": Edit(("tf",), _mounting(_turned(2))),
    "camera prior pitch": Edit(("tf",), _mounting(_turned(0))),
    "doppler": Edit(("radar",), _cloud(_doppler)),
    "odometry speed": Edit(("odometry",), _odometry(scaled=True)),
    "odometry turn rate": Edit(("odometry",), _odometry(angular=-1.0)),
    "odometry reversed": Edit(("odometry",), _odometry(-1.0, -1.0)),
    "odometry late": Edit(("odometry",), _stamped, raw=True),
    "odometry silent": Edit(("odometry",), _silent, raw=True),
}
