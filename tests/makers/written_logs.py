"""Small real logs, written by the public writers of mcap and rosbags: MCAP, ROS 1 bag, ROS 2 bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import mcap.writer
import numpy as np
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.core.config import FleetConfig

START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 100_000_000
IMAGE, INFO, LIDAR, RADAR = "/camera/image", "/camera/info", "/lidar/points", "/radar/points"
LABELS, DETECTIONS, ODOMETRY = "/perception/labels", "/perception/detections", "/odometry"
WIDTH, HEIGHT = 96, 64
_DATATYPE = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_DETECTIONS = {
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n"
}
_NEW_DETECTIONS = _DETECTIONS | {
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id\n"
    ),
}
_OLD_DETECTIONS = _DETECTIONS | {
    "vision_msgs/msg/BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\n"
    ),
}
_RADAR = {
    "radar_msgs/msg/RadarReturn": (
        "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\nfloat32 amplitude\n"
    ),
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nradar_msgs/RadarReturn[] returns\n",
    "radar_msgs/msg/RadarTracks": "std_msgs/Header header\nradar_msgs/RadarTrack[] tracks\n",
}
_TRACK = (
    "{}\ngeometry_msgs/Point position\ngeometry_msgs/Vector3 velocity\n"
    "geometry_msgs/Vector3 acceleration\ngeometry_msgs/Vector3 size\n{} classification\n"
)


@dataclass
class Kit:
    """Makes messages of one ROS generation and writes them as logs."""

    ros: int = 2
    old_types: bool = False
    frames: int = 4
    messages: list[tuple[str, str, int, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros == 2 else Stores.ROS1_NOETIC)
        for name in [n for n in self.store.fielddefs if n.startswith(("vision_msgs/", "radar_msgs/"))]:
            del self.store.fielddefs[name]
        types = _RADAR | (_OLD_DETECTIONS if self.old_types else _NEW_DETECTIONS)
        is_old = self.old_types or self.ros == 1  # rosbags' ROS 1 store lacks UUID and tf2
        track = ("uint16 track_id", "string") if is_old else ("unique_identifier_msgs/UUID uuid", "uint16")
        types["radar_msgs/msg/RadarTrack"] = _TRACK.format(*track)
        if self.ros == 1:
            types["tf2_msgs/msg/TFMessage"] = "geometry_msgs/TransformStamped[] transforms\n"
        for name, text in types.items():
            self.store.register(get_types_from_msg(text, name))

    # -- messages ------------------------------------------------------------

    def new(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self.new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        sequence = {"seq": 0} if self.ros == 1 else {}
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **sequence)

    def stamped(self, kind: str, stamp_ns: int, frame_id: str, **fields: Any) -> Any:
        return self.new(kind, header=self.header(stamp_ns, frame_id), **fields)

    def vector(self, kind: str, x: float, y: float, z: float) -> Any:
        return self.new(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))

    def quaternion(self, w: float, x: float, y: float, z: float) -> Any:
        return self.new("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))

    def compressed(
        self, stamp_ns: int, data: bytes, form: str = "jpeg", frame_id: str = "camera_optical"
    ) -> Any:
        kind, array = "sensor_msgs/msg/CompressedImage", np.frombuffer(data, np.uint8)
        return self.stamped(kind, stamp_ns, frame_id, format=form, data=array)

    def image(self, stamp_ns: int, pixels: np.ndarray, encoding: str, step: int | None = None) -> Any:
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        if step is not None:
            rows = np.pad(rows, ((0, 0), (0, step - rows.shape[1])), constant_values=77)
        size = {"height": height, "width": width, "step": rows.shape[1]}
        data = {"encoding": encoding, "is_bigendian": 0, "data": rows.reshape(-1)}
        return self.stamped("sensor_msgs/msg/Image", stamp_ns, "camera_optical", **size, **data)

    def info(
        self, stamp_ns: int, focal_px: float = 80.0, model: str = "plumb_bob", D: Any = (0.0,) * 5
    ) -> Any:
        K = np.array(
            [focal_px, 0, WIDTH / 2, 0, focal_px, HEIGHT / 2, 0, 0, 1 if focal_px else 0], np.float64
        )
        none = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        roi = self.new("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **none)
        arrays = (np.array(D, np.float64), K, np.eye(3).reshape(-1), np.zeros(12))
        fields = dict(zip("dkrp" if self.ros == 2 else "DKRP", arrays, strict=True))
        fields |= {"height": HEIGHT, "width": WIDTH, "distortion_model": model, "roi": roi}
        kind = "sensor_msgs/msg/CameraInfo"
        return self.stamped(kind, stamp_ns, "camera_optical", binning_x=0, binning_y=0, **fields)

    def cloud(
        self, stamp_ns: int, columns: dict[str, np.ndarray], *, frame_id: str = "lidar",
        big_endian: bool = False, padding: int = 0, rows: int = 1, row_padding: int = 0,
        counts: dict[str, int] | None = None,
    ) -> Any:  # fmt: skip
        """A PointCloud2 of these columns in this order; dtypes are the columns' own."""
        order, counts, offset, fields, formats = ">" if big_endian else "<", counts or {}, padding, [], []
        for name, values in columns.items():
            code = values.dtype.str[1:]
            about = {"name": name, "offset": offset, "datatype": _DATATYPE[code]}
            fields.append(self.new("sensor_msgs/msg/PointField", count=counts.get(name, 1), **about))
            formats.append((order + code, values.shape[1:]))
            offset += values.dtype.itemsize * int(np.prod(values.shape[1:], dtype=int)) + padding
        offsets = [f.offset for f in fields]
        dtype = np.dtype(
            {"names": [*columns], "formats": formats, "offsets": offsets, "itemsize": max(offset, 1)}
        )
        count = len(next(iter(columns.values())))
        points = np.full(count * dtype.itemsize, 0xAB, np.uint8).view(dtype)
        for name, values in columns.items():
            points[name] = values
        data = points.view(np.uint8).reshape(rows, -1)
        data = np.pad(data, ((0, 0), (0, row_padding)), constant_values=0xCD)
        layout = {"height": rows, "width": count // rows, "row_step": data.shape[1], "data": data.reshape(-1)}
        layout |= {"fields": fields, "point_step": dtype.itemsize, "is_bigendian": big_endian}
        return self.stamped("sensor_msgs/msg/PointCloud2", stamp_ns, frame_id, is_dense=False, **layout)

    def transform(
        self, stamp_ns: int, parent: str, child: str, q: Any = (1, 0, 0, 0), t: Any = (0, 0, 0)
    ) -> Any:
        parts = {"translation": self.vector("Vector3", *t), "rotation": self.quaternion(*q)}
        body = self.new("geometry_msgs/msg/Transform", **parts)
        kind = "geometry_msgs/msg/TransformStamped"
        return self.stamped(kind, stamp_ns, parent, child_frame_id=child, transform=body)

    def tf(self, *transforms: Any) -> Any:
        return self.new("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def odometry(self, stamp_ns: int, x: float, yaw: float, speed: float, yaw_rate: float) -> Any:
        speeds = {
            "linear": self.vector("Vector3", speed, 0, 0),
            "angular": self.vector("Vector3", 0, 0, yaw_rate),
        }
        twist = self.new("geometry_msgs/msg/Twist", **speeds)
        parts = {
            "pose": self.pose(x, self.quaternion(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))),
            "twist": self.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        }
        return self.stamped("nav_msgs/msg/Odometry", stamp_ns, "odom", child_frame_id="base_link", **parts)

    def pose(self, x: float, orientation: Any) -> Any:
        """A PoseWithCovariance on the x axis."""
        pose = self.new(
            "geometry_msgs/msg/Pose", position=self.vector("Point", x, 0, 0), orientation=orientation
        )
        return self.new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))

    def detections(self, stamp_ns: int, boxes: list[tuple[float, float, float, float, str, float]]) -> Any:
        """Boxes as centre x, y, width, height, class, score."""
        pose, found = self.pose(0, self.quaternion(1, 0, 0, 0)), []
        for x, y, width, height, name, score in boxes:
            kind = "vision_msgs/msg/ObjectHypothesisWithPose"
            if self.old_types:
                result = self.new(kind, id=name, score=score, pose=pose)
                centre, rest = self.new("geometry_msgs/msg/Pose2D", x=x, y=y, theta=0.0), {}
            else:
                hypothesis = self.new("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score)
                result, rest = self.new(kind, hypothesis=hypothesis, pose=pose), {"id": ""}
                point = self.new("vision_msgs/msg/Point2D", x=x, y=y)
                centre = self.new("vision_msgs/msg/Pose2D", position=point, theta=0.0)
            rest["bbox"] = self.new(
                "vision_msgs/msg/BoundingBox2D", center=centre, size_x=width, size_y=height
            )
            kind = "vision_msgs/msg/Detection2D"
            found.append(self.stamped(kind, stamp_ns, "camera_optical", results=[result], **rest))
        kind = "vision_msgs/msg/Detection2DArray"
        return self.stamped(kind, stamp_ns, "camera_optical", detections=found)

    # -- a drive -------------------------------------------------------------

    def drive(self, start_ns: int = START_NS) -> Kit:
        """Append a drive: tf_static once, then the six messages of every frame."""
        begun = (start_ns - START_NS) // PERIOD_NS  # of two drives no message is the same
        places = {"camera_optical": ((0.5, -0.5, 0.5, -0.5), (1.5, 0, 1.4))}
        places |= {"lidar": ((1, 0, 0, 0), (1.0, 0, 1.8)), "radar": ((1, 0, 0, 0), (3.6, 0.1, 0.5))}
        tf = self.tf(*(self.transform(start_ns, "base_link", name, *of) for name, of in places.items()))
        self.add("/tf_static", tf.__msgtype__, start_ns, tf)
        for i in range(self.frames):
            stamp = start_ns + i * PERIOD_NS
            seen, boxes = stamp + 1_000_000, [(20.0 + i, 30.0, 10.0, 8.0, "car", 0.9)]
            for topic, message in (
                (INFO, self.info(seen)),
                (IMAGE, self.compressed(seen, jpeg(i + begun))),
                (LABELS, self.compressed(seen, label_png(i), "mono8; png compressed")),
                (DETECTIONS, self.detections(seen, boxes)),
                (LIDAR, self.cloud(stamp, lidar_columns(i + begun))),
                (RADAR, self.cloud(stamp - 2_000_000, radar_columns(i + begun), frame_id="radar")),
            ):
                self.add(topic, message.__msgtype__, stamp, message)
        return self

    def add(self, topic: str, kind: str, log_time_ns: int, message: Any) -> None:
        self.messages.append((topic, kind, log_time_ns, message))

    def without(self, topic: str) -> Kit:
        self.messages = [m for m in self.messages if m[0] != topic]
        return self

    def replaced(self, topic: str, number: int, message: Any) -> Kit:
        """Put another message in the place of the `number`-th of a topic."""
        place = [i for i, m in enumerate(self.messages) if m[0] == topic][number]
        _, kind, log_time, _ = self.messages[place]
        self.messages[place] = (topic, getattr(message, "__msgtype__", kind), log_time, message)
        return self

    def each(self, topic: str, make: Callable[[int, int], Any]) -> Kit:
        """Put `make(number, stamp of its frame)` in the place of the message of every frame of a topic."""
        for i in range(self.frames):
            self.replaced(topic, i, make(i, START_NS + i * PERIOD_NS))
        return self

    def driven(self, speed_mps: float, yaw_rate: float = 0.0) -> Kit:
        """Add odometry of a constant motion, two messages a frame, from before the first to after the last."""
        for i in range(-3, 2 * self.frames + 4):
            stamp = START_NS + i * PERIOD_NS // 2
            message = self.odometry(stamp, 0.05 * i * speed_mps, 0.05 * i * yaw_rate, speed_mps, yaw_rate)
            self.add(ODOMETRY, "nav_msgs/msg/Odometry", stamp, message)
        return self

    # -- containers ----------------------------------------------------------

    def mcap(
        self, path: Path, *, compression: str = "ZSTD", chunk_size: int = 40_000, **options: Any
    ) -> Path:
        with path.open("wb") as stream:
            writer = mcap.writer.Writer(
                stream, chunk_size=chunk_size, compression=mcap.writer.CompressionType[compression], **options
            )
            writer.start(profile="ros2", library="test")
            schemas: dict[str, int] = {}
            channels: dict[tuple[str, str], int] = {}
            for topic, kind, log_time, message in self.messages:
                if kind not in schemas:
                    text = self.store.generate_msgdef(kind, ros_version=2)[0]
                    schemas[kind] = writer.register_schema(kind, "ros2msg", text.encode())
                if (topic, kind) not in channels:
                    channels[topic, kind] = writer.register_channel(topic, "cdr", schemas[kind])
                data = bytes(self.store.serialize_cdr(message, kind))
                writer.add_message(channels[topic, kind], log_time, data, log_time)
            writer.finish()
        return path

    def bag(self, path: Path, compression: str | None = None) -> Path:
        writer = BagWriter(path)
        if compression is not None:
            writer.set_compression(BagWriter.CompressionFormat[compression])
        writer.chunk_threshold = 40_000
        return self._bag(path, writer, self.store.serialize_ros1)

    def folder(self, path: Path, storage: str = "SQLITE3") -> Path:
        writer = FolderWriter(path, version=9, storage_plugin=StoragePlugin[storage])
        return self._bag(path, writer, self.store.serialize_cdr)

    def _bag(self, path: Path, writer: Any, serialise: Any) -> Path:
        with writer:
            connections: dict[tuple[str, str], Any] = {}
            for topic, kind, log_time, message in self.messages:
                if (topic, kind) not in connections:
                    connections[topic, kind] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic, kind], log_time, bytes(serialise(message, kind)))
        return path


def lidar_columns(i: int, count: int = 800) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(100 + i)
    xyz = rng.uniform((2, -20, -1.7), (60, 20, 3), (count, 3)).astype(np.float32)
    return dict(zip("xyz", xyz.T, strict=True)) | {
        "intensity": rng.uniform(0, 255, count).astype(np.float32),
        "ring": (np.arange(count) % 16).astype(np.uint16),
        "time": np.linspace(-0.1, 0, count).astype(np.float32),
    }


def radar_columns(i: int, count: int = 60) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(200 + i)
    xyz = rng.uniform((5, -20, -1), (80, 20, 2), (count, 3)).astype(np.float32)
    doppler = (10.0 * xyz[:, 0] / np.linalg.norm(xyz, axis=1)).astype(np.float32)  # approaching at 10 m/s
    return dict(zip("xyz", xyz.T, strict=True)) | {"doppler": doppler, "power": doppler * 0 + 30}


def jpeg(i: int) -> bytes:
    pixels = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def label_png(i: int) -> bytes:
    labels = np.random.default_rng(i).integers(0, 19, (HEIGHT, WIDTH), np.uint8)
    return cv2.imencode(".png", labels)[1].tobytes()


def fleet_config(**sections: Any) -> FleetConfig:
    semantics = {"source": "topics", "labels": LABELS, "detections": DETECTIONS}
    rig = {
        "camera": {"image": IMAGE, "info": INFO, "semantics": semantics},
        "lidar": {"points": LIDAR},
        "radar": {"points": RADAR, "doppler_positive": "approaching"},
        "ego": {"odometry": ODOMETRY},
    }
    for name in ("radar", "prior"):
        rig[name] = {**rig.get(name, {}), **sections.pop(name, {})}
    return FleetConfig.model_validate(
        {"fleet": {"name": "test"}, "rigs": {"default": rig}, "vehicles": {"car": {}}, **sections}
    )
