"""Frames as a nuScenes folder: tables in v1.0-boresight, files in samples; every frame is a sample.

nuScenes' lidar looks along y, with x to the right. Its radar has a velocity vector: here the measured
component along the ray. Boxes are in nuImages' table object_ann, because they are boxes in images and
nuScenes' own are in space.

Source: nuscenes-devkit, docs/schema_nuscenes.md, docs/schema_nuimages.md, utils/data_classes.py,
utils/splits.py.

Images, labels and boxes are of a camera without distortion: the format has none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import ConfigError, SolveError
from pipeline.learn.frames.frame import Frame, to_json
from pipeline.learn.frames.output import DayOutput, Output
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import exp_se3, from_rotation_translation, inverse, to_quaternion
from pipeline.store.partitions import Partition
from schemas.captures import CameraColumns, Image, Scan, Sweep
from schemas.features import ImageFeatureColumns
from schemas.training import SPLITS

__all__ = [
    "VERSION", "Boxes", "NuScenesWriter", "Undistortion", "finish_nuscenes", "token_of", "undistortion_of",
]  # fmt: skip

# Channels of sensors that are called by their kinds, as loaders expect them.
_CHANNELS = {"camera": "CAM_FRONT", "lidar": "LIDAR_TOP", "radar": "RADAR_FRONT"}
_KINDS = {Image: ("CAM", "camera"), Sweep: ("LIDAR", "lidar"), Scan: ("RADAR", "radar")}
_T_NUSCENES_LIDAR = from_rotation_translation(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
_RADAR = (
    "x:f4 y:f4 z:f4 dyn_prop:i1 id:i2 rcs:f4 vx:f4 vy:f4 vx_comp:f4 vy_comp:f4 is_quality_valid:i1 ambig_state:i1 "
    "x_rms:i1 y_rms:i1 invalid_state:i1 pdh0:i1 vx_rms:i1 vy_rms:i1"
)
_UNAMBIGUOUS = 3


class NuScenesWriter:
    """Writes files and rows as frames come; a scene is one log, drive and split.

    A row is written when the next row of its chain, to which it refers, is known.
    """

    def __init__(self, output: DayOutput, _stack: ExitStack) -> None:
        self._output = output
        self._count = 0  # samples of the scene that is open
        self._last: dict[str, Any] = {}
        self._scene: tuple[Any, ...] = ()
        self._latest: dict[str, dict[str, Any]] = {}  # row of sample_data by channel
        self._known: set[str] = set()

    def add(self, frame: Frame) -> None:
        """Write a frame.

        Raises:
            SolveError: the log has no odometry, without which nuScenes has no ego_pose.
            ConfigError: a camera cannot be undistorted.
        """
        scene = (frame.moment.log, frame.moment.drive, frame.at.split)
        if scene != self._scene:
            self.close()
            self._scene = scene
        if not self._count:
            self._first = frame
        sample = {
            "token": token_of("sample", frame.key), "timestamp": _us(frame.moment.stamp_ns),
            "scene_token": token_of("scene", self._first.key), "prev": self._last.get("token", ""),
        }  # fmt: skip
        self._follow("sample", self._last, sample["token"])
        self._last, self._count = sample, self._count + 1
        for name in frame.captures:
            self._sample_data(frame, name, str(sample["token"]))

    def close(self) -> None:
        """Write the scene that is open."""
        if not self._count:
            return
        for table, row in (("sample", self._last), *(("sample_data", row) for row in self._latest.values())):
            self._follow(table, row, "")
        at, first = self._first.partition, self._first.key
        log = token_of("log", at.folder, self._first.moment.log)
        scene = {
            "token": token_of("scene", first), "log_token": log, "nbr_samples": self._count, "name": first,
            "first_sample_token": token_of("sample", first), "last_sample_token": self._last["token"],
            "description": f"{self._first.at.split}, {self._first.moment.log}, {self._first.at.environment}",
        }  # fmt: skip
        self._output.list("scene", scene)
        self._output.list(self._first.at.split, first)
        about = {"vehicle": at.vehicle, "date_captured": at.day, "location": "unknown"}
        self._once("log", {"token": log, "logfile": self._first.moment.log, **about})
        self._last, self._latest, self._count = {}, {}, 0

    def _follow(self, table: str, row: dict[str, Any], following: Any) -> None:
        """List a row, if there is one, with the token of the one that follows it."""
        if row:
            self._output.list(table, row | {"next": following})

    def _sample_data(self, frame: Frame, name: str, sample: str) -> None:
        capture, upper = frame.captures[name], name.upper()
        prefix = _KINDS[type(capture)][0]
        channel = _CHANNELS.get(name) or (upper if upper.startswith(prefix) else f"{prefix}_{upper}")
        T_odom_ego = _pose_at(frame, capture.stamp_ns)
        if T_odom_ego is None:
            problem = "nuScenes needs the car's pose at each sample, and the logs have no odometry: take another format"
            raise SolveError(problem)
        token, before = token_of("data", frame.key, channel), self._latest.get(channel, {})
        data, suffix = _file(frame, name)
        path = f"samples/{channel}/{frame.key}{suffix}"
        self._output.put(path, data)
        row = {
            "token": token, "sample_token": sample, "ego_pose_token": token, "timestamp": _us(capture.stamp_ns),
            "calibrated_sensor_token": self._calibrated(frame, name, channel), "fileformat": suffix.strip("."),
            "is_key_frame": True, "filename": path, "prev": before.get("token", ""),
            "height": capture.image_height_px if isinstance(capture, Image) else 0,
            "width": capture.image_width_px if isinstance(capture, Image) else 0,
        }  # fmt: skip
        self._follow("sample_data", before, token)
        self._latest[channel] = row
        at = {"token": token, "timestamp": _us(capture.stamp_ns)}
        self._output.list("ego_pose", at | _pose(T_odom_ego))
        if isinstance(capture, Image):
            self._seen(frame, name, channel, token, capture)

    def _seen(self, frame: Frame, name: str, channel: str, token: str, image: Image) -> None:
        if (seen := frame.seen.get(name)) is None:
            return
        undistortion = undistortion_of(image, name)
        self._output.put(f"labels/{channel}/{frame.key}.png", undistortion.labels(seen))
        for k, (box, kind, score) in enumerate(undistortion.boxes(seen)):
            category = token_of("category", kind)
            self._once("category", {"token": category, "name": kind, "description": "", "index": 0})
            self._output.list("object_ann", {
                "token": token_of("box", token, str(k)), "sample_data_token": token, "category_token": category,
                "bbox": box, "score": score, "attribute_tokens": [], "mask": None,
            })  # fmt: skip

    def _calibrated(self, frame: Frame, name: str, channel: str) -> str:
        capture, sensor = frame.captures[name], token_of("sensor", channel)
        modality = _KINDS[type(capture)][1]
        self._once("sensor", {"token": sensor, "channel": channel, "modality": modality})
        K = capture.camera_K.tolist() if isinstance(capture, Image) else []
        given = _pose(_channel_pose(frame, frame.T[name], capture))
        row = {"sensor_token": sensor, **given, "camera_intrinsic": K}
        row["token"] = token_of("calibrated", frame.partition.folder, channel, repr(row))
        self._once("calibrated_sensor", row)
        if frame.answer is not None:
            answer = _pose(_channel_pose(frame, frame.answer[name], capture))
            self._once("calibrated_sensor_answer", {**row, **answer})
        return str(row["token"])

    def _once(self, table: str, row: dict[str, Any]) -> None:
        """Add a row that others may have added."""
        if (key := f"{table} {row['token']}") not in self._known:
            self._known.add(key)
            self._output.list(table, row)


def _channel_pose(frame: Frame, T: np.ndarray, capture: object) -> np.ndarray:
    T_root = T_root_sensor(frame, T)
    return T_root @ inverse(_T_NUSCENES_LIDAR) if isinstance(capture, Sweep) else T_root


def _file(frame: Frame, name: str) -> tuple[bytes, str]:
    """Content of a sensor's file, and how its name ends."""
    capture = frame.captures[name]
    if isinstance(capture, Sweep):
        count = len(capture.lidar_x_m)
        beside = [np.zeros(count) if c is None else c for c in (capture.lidar_intensity, capture.lidar_ring)]
        columns = [-capture.lidar_y_m, capture.lidar_x_m, capture.lidar_z_m, *beside]
        return np.stack(columns, -1).astype("<f4").tobytes(), ".pcd.bin"
    if isinstance(capture, Scan):
        return _pcd(frame, name, capture), ".pcd"
    suffix = ".jpg" if capture.image_format == "jpeg" else ".png"
    return undistortion_of(capture, name).encoded(capture, suffix), suffix


def _pcd(frame: Frame, name: str, scan: Scan) -> bytes:
    dtype = np.dtype([(n, f"<{t}") for n, t in (word.split(":") for word in _RADAR.split())])
    rows = np.zeros(len(scan.radar_x_m), dtype)
    flat = np.maximum(np.hypot(scan.radar_x_m, scan.radar_y_m), 1e-6)
    own = _compensated_range_rate(frame, name, scan)
    for column, values in (("x", scan.radar_x_m), ("y", scan.radar_y_m), ("z", scan.radar_z_m)):
        rows[column] = values
    for axis, along in (("x", scan.radar_x_m / flat), ("y", scan.radar_y_m / flat)):
        rows[f"v{axis}"], rows[f"v{axis}_comp"] = scan.radar_range_rate_mps * along, own * along
    rows["rcs"] = 0 if scan.radar_power_db is None else scan.radar_power_db
    rows["id"], rows["is_quality_valid"], rows["ambig_state"] = np.arange(len(rows)), 1, _UNAMBIGUOUS
    if not len(
        rows
    ):  # the devkit takes one point of NaN for an empty scan, and cannot open one without a point
        rows = np.zeros(1, dtype)
        rows["x"], rows["y"], rows["z"], rows["invalid_state"] = np.nan, np.nan, np.nan, 1
    names = dtype.names or ()
    kinds = [dtype[n].str[1:] for n in names]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(names)}\nSIZE {' '.join(k[1:] for k in kinds)}\n"
        f"TYPE {' '.join(k[0].upper() for k in kinds)}\nCOUNT {' '.join('1' for _ in names)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    return header.encode() + rows.tobytes() + b"\n"  # the devkit wants a byte behind the last point


def _pose(T: np.ndarray) -> dict[str, list[float]]:
    return {"rotation": to_quaternion(T).tolist(), "translation": T[:3, 3].tolist()}


def _us(stamp_ns: int) -> int:
    return round(stamp_ns / 1000)


def T_root_sensor(frame: Frame, T_reference_sensor: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A pose on the car, or on the reference if its pose on the car is unknown."""
    T_base = frame.mounting.T_base_reference
    return T_reference_sensor if T_base is None else T_base @ T_reference_sensor


def _pose_at(frame: Frame, stamp_ns: int) -> Float[np.ndarray, "4 4"] | None:
    """T_odom_vehicle at a stamp near the moment's, by speed and yaw rate; None without odometry."""
    T, speed, turn = frame.T_odom_vehicle, frame.moment.ego_speed_mps, frame.moment.ego_yaw_rate_radps
    if T is None or speed is None or turn is None:
        return None
    dt_s = (stamp_ns - frame.moment.stamp_ns) * 1e-9
    return T @ exp_se3(np.array([0.0, 0, turn, speed, 0, 0]) * dt_s)


def _compensated_range_rate(frame: Frame, sensor: str, scan: Scan) -> Float[np.ndarray, " M"]:
    """Range rates without the car's own motion: 0 for static objects; NaN if it is unknown."""
    speed, turn = frame.moment.ego_speed_mps, frame.moment.ego_yaw_rate_radps
    if speed is None or turn is None:
        return np.full(len(scan.radar_x_m), np.nan)
    T = T_root_sensor(frame, frame.T[sensor])
    velocity_radar = T[:3, :3].T @ (np.array([speed, 0, 0]) + np.cross([0, 0, turn], T[:3, 3]))
    points = scan.radar_xyz_m.astype(np.float64)
    rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
    return scan.radar_range_rate_mps + rays @ velocity_radar


VERSION = "v1.0-boresight"
# Tables that the devkit opens; the last three are of others.
_TABLES = (
    "category", "attribute", "visibility", "instance", "sensor", "calibrated_sensor", "ego_pose", "log",
    "scene", "sample", "sample_data", "sample_annotation", "map", "object_ann", "calibrated_sensor_answer",
)  # fmt: skip
_SHARED = {"sensor", "category"}


def finish_nuscenes(output: Output, days: Sequence[Partition]) -> None:
    """Write all tables, and the splits by scene; one row is in memory at a time."""
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    logs: list[str] = []
    known: set[str] = set()  # of tables whose rows several days share
    with ExitStack() as stack:
        streams = {t: stack.enter_context(output.replacing(f"{VERSION}/{t}.json")) for t in _TABLES}
        began = set[str]()
        for day in days:
            for table, row in output.rows(day):
                if table in splits:
                    splits[table].append(row)
                if table not in streams or row["token"] in known:
                    continue
                known |= {row["token"]} if table in _SHARED else set()
                logs += [row["token"]] if table == "log" else []
                streams[table].write((b",\n" if table in began else b"[\n") + to_json(row))
                began.add(table)
        streams["map"].write(b"[\n" + to_json({
            "token": token_of("map"), "log_tokens": logs, "category": "none", "filename": "maps/none.png",
        }))  # fmt: skip
        for table, stream in streams.items():
            stream.write(b"\n]\n" if table in began | {"map"} else b"[]\n")
    output.write("maps/none.png", cv2.imencode(".png", np.full((1, 1), 128, np.uint8))[1].tobytes())
    output.write(f"{VERSION}/splits.json", to_json(splits))


def token_of(*words: str) -> str:
    """32 hexadecimal digits that are the same for the same words."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:32]


_WIDEST_DEG = 170.0  # a plane shows nothing at 180 deg, and next to nothing beyond this
_VOID = 255
Boxes = list[tuple[list[float], str, float]]  # x0 y0 x1 y1 [px], class, score


@dataclass(frozen=True, eq=False)
class Undistortion:
    """From a camera's images to those of a pinhole camera with the same K and size; edges of a wide view are lost."""

    camera: Camera
    # Where in the image each pixel comes from; None: it has no distortion.
    maps: tuple[np.ndarray, np.ndarray] | None

    def pixels(self, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
        """Decoded image, black where the camera saw nothing; raises ConfigError if it cannot be decoded."""
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise ConfigError("lake", "images", "an image cannot be decoded")
        return image if self.maps is None else cv2.remap(image, *self.maps, cv2.INTER_LINEAR)

    def encoded(self, image: Image, suffix: str) -> bytes:
        """An image as a file; as logged, byte for byte, if it has that format and no distortion."""
        if self.maps is None and {"jpeg": ".jpg", "png": ".png"}[image.image_format] == suffix:
            return image.image
        options = [cv2.IMWRITE_JPEG_QUALITY, 95] if suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 1]
        return cv2.imencode(suffix, self.pixels(image.image), options)[1].tobytes()

    def labels(self, found: ImageFeatureColumns) -> bytes:
        """A label image at the image's size, nearest neighbours, void where the camera saw nothing."""
        small = cv2.imdecode(np.frombuffer(found.labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
        size = (self.camera.width_px, self.camera.height_px)
        full = cv2.resize(small, size, interpolation=cv2.INTER_NEAREST)
        if self.maps is not None:
            beyond = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": _VOID}
            full = cv2.remap(full, *self.maps, cv2.INTER_NEAREST, **beyond)
        return cv2.imencode(".png", full)[1].tobytes()

    def boxes(self, found: ImageFeatureColumns) -> Boxes:
        """Boxes around the undistorted corners and edge centres of the logged ones."""
        told = zip(found.road_user_boxes_px, found.road_user_classes, found.road_user_scores, strict=True)
        moved = [(self._box(box), name, float(score)) for box, name, score in told]
        return [(box, name, score) for box, name, score in moved if box is not None]

    def _box(self, box: Float[np.ndarray, " 4"]) -> list[float] | None:
        size = np.array([self.camera.width_px, self.camera.height_px]) - 1
        corners = np.array([(u, v) for u in (box[0], (box[0] + box[2]) / 2, box[2])
                            for v in (box[1], (box[1] + box[3]) / 2, box[3])], np.float64)  # fmt: skip
        if self.maps is not None:
            rays = self.camera.unproject(corners)
            rays = rays[rays[:, 2] > 0]  # False for NaN, too
            corners = (rays / rays[:, 2:]) @ self.camera.K.T
        if not len(corners):
            return None
        ends = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        low, high = (np.clip(end, 0, size) for end in ends)
        return [*map(float, low), *map(float, high)] if np.all(high > low) else None


def undistortion_of(image: CameraColumns, sensor: str) -> Undistortion:
    """Maps to a pinhole camera, cached; raises ConfigError if the camera sees more than a plane shows."""
    c = camera_of(image)
    return _made(sensor, c.model, c.K.tobytes(), c.D.tobytes(), c.width_px, c.height_px)


@lru_cache(maxsize=16)
def _made(sensor: str, model: str, K: bytes, D: bytes, width_px: int, height_px: int) -> Undistortion:
    camera = Camera(model, np.frombuffer(K).reshape(3, 3), np.frombuffer(D), width_px, height_px)
    seen = _field_deg(camera)
    if seen > _WIDEST_DEG:
        problem = (
            f"sees {seen:.0f} deg, and an undistorted image can show {_WIDEST_DEG:.0f} at most: take parquet, "
            "whose images are as logged, or leave the camera out with --sensor"
        )
        raise ConfigError("command line", sensor, problem)
    if model != "equidistant" and not np.any(camera.D):
        return Undistortion(camera, None)
    u, v = np.meshgrid(np.arange(width_px), np.arange(height_px))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T
    uv, valid = camera.project(rays)
    uv = np.where(valid[..., None], uv, -1e4).astype(np.float32)
    return Undistortion(camera, (np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])))


def _field_deg(camera: Camera) -> float:
    """Angle between the rays of the middle of the left and of the right side."""
    v = float(camera.K[1, 2])
    ends = camera.unproject(np.array([[0.0, v], [camera.width_px - 1.0, v]]))
    angles = np.arctan2(np.abs(ends[:, 0]), ends[:, 2])
    known = np.where(np.isfinite(angles), angles, camera.max_angle_rad)
    return float(np.degrees(known.sum()))
