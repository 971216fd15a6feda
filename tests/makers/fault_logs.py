"""Faults put into recorded logs: every message of a day is copied, and an edit changes those of some topics on the way.

An edit takes a message of the log, and the share of its topic's messages that lie before it; None leaves it out.
"""

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.ingest.containers.reader import open_log
from pipeline.rig.se3 import exp_so3, from_quaternion, to_quaternion

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


def rewrite_logs(logs, out, topics, edit):
    """Copy CDR logs of a vehicle-day, in order of time, as MCAP into `out`, with an edit of `topics`."""
    count, number = dict.fromkeys(topics, 0), dict.fromkeys(topics, 0)
    for log in logs:
        reader = open_log(log)
        for raw in reader.scan(set(topics)):
            count[raw.channel.topic] += 1
        reader.close()
    paths = []
    for k, log in enumerate(logs):
        paths.append(out / f"{k:02d}.mcap")
        _copy(log, paths[-1], edit, count, number)
    return paths


def _copy(log, path, edit, count, number):
    path.parent.mkdir(parents=True, exist_ok=True)
    reader, channels = open_log(log), {}
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4 << 20, compression=CompressionType.LZ4)
        writer.start(profile="ros2", library="tests")
        for raw in reader.scan():
            channel, data = raw.channel, bytes(raw.data)
            if (topic := channel.topic) in count:
                message = edit(_STORE.deserialize_cdr(data, channel.msgtype), number[topic] / count[topic])
                number[topic] += 1
                if message is None:
                    continue
                data = bytes(_STORE.serialize_cdr(message, channel.msgtype))
            if topic not in channels:
                definition = channel.definition.encode()
                schema = writer.register_schema(name=channel.msgtype, encoding="ros2msg", data=definition)
                channels[topic] = writer.register_channel(
                    topic=topic, message_encoding=channel.encoding, schema_id=schema
                )
            at = raw.log_time_ns
            writer.add_message(channels[topic], log_time=at, publish_time=at, data=data)
        writer.finish()
    reader.close()


def silent(_message, _share):
    return None


def stuck():
    """The first payload under each message's own stamp."""
    held = []

    def edit(message, _share):
        held.append(message.data)
        message.data = held[0]
        return message

    return edit


def cloud(change):
    """An edit of the rows of a PointCloud2 (a structured array), which takes the share as well."""

    def edit(message, share):
        dtype = np.dtype({
            "names": [f.name for f in message.fields],
            "formats": [_CODES[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        })  # fmt: skip
        rows = change(np.frombuffer(message.data.tobytes(), dtype).copy(), share)
        message.height, message.width, message.row_step = 1, len(rows), message.point_step * len(rows)
        message.data = np.frombuffer(rows.tobytes(), np.uint8)
        return message

    return edit


def points(matrix, after=0.0):
    """Points multiplied by a matrix (3 3) after a share of the day."""

    def change(rows, share):
        if share >= after:
            xyz = np.stack([rows["x"], rows["y"], rows["z"]], 1).astype(np.float64) @ np.asarray(matrix)
            rows["x"], rows["y"], rows["z"] = xyz.T
        return rows

    return cloud(change)


def turned(deg, axis=2):
    """Takes points to the axes of a sensor that is turned about one of its own."""
    return exp_so3(np.radians(deg) * np.eye(3)[axis])


empty = cloud(lambda rows, _share: rows[:0])


def labels_right(px):
    """Label images moved; what comes in from outside is the border repeated."""

    def edit(message, _share):
        pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        move, size = np.array([[1.0, 0, px], [0, 1, 0]]), pixels.shape[1::-1]
        moved = cv2.warpAffine(pixels, move, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        message.data = cv2.imencode(".png", moved)[1].ravel()
        return message

    return edit


def focal(share_of_it):
    def edit(message, _share):
        message.k, message.p = message.k.copy(), message.p.copy()
        message.k[[0, 4]] *= 1 + share_of_it
        message.p[[0, 5]] *= 1 + share_of_it
        return message

    return edit


def odometry(factor):
    """Speeds and turn rates, multiplied."""

    def edit(message, _share):
        for vector in (message.twist.twist.linear, message.twist.twist.angular):
            vector.x, vector.y, vector.z = factor * vector.x, factor * vector.y, factor * vector.z
        return message

    return edit


def mounted(frame, step):
    """The sensor's edge of tf_static, composed with a step (4 4) in the sensor's own axes."""

    def edit(message, _share):
        for edge in message.transforms:
            # Where the sensor is the parent, the step is undone on the other side.
            child, parent = edge.child_frame_id == frame, edge.header.frame_id == frame
            if child or parent:
                q, t = edge.transform.rotation, edge.transform.translation
                T = from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z]))
                T = T @ step if child else np.linalg.inv(step) @ T
                q.w, q.x, q.y, q.z = (float(v) for v in to_quaternion(T))
                t.x, t.y, t.z = (float(v) for v in T[:3, 3])
        return message

    return edit
