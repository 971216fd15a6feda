"""One message of a sensor to one row of its table; only payloads of kept moments are decoded."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.config import IngestConfig
from pipeline.core.errors import LogError
from pipeline.core.rigs import CameraTopics, RadarTopics, TopicSemantics
from pipeline.ingest.earlier_images import EarlierImages
from pipeline.ingest.index import DayIndex, Located
from pipeline.ingest.messages.decoding import DECODE_ERRORS, decode, header_frame_id
from pipeline.ingest.messages.detections import DETECTIONS_3D, read_detections, read_detections_3d
from pipeline.ingest.messages.image import (
    EncodedImage,
    encode_pixels,
    encode_raw_image,
    inspect_image,
    label_image,
)
from pipeline.ingest.messages.odometry import EgoState
from pipeline.ingest.messages.point_cloud import LidarCloud, read_lidar
from pipeline.ingest.messages.radar import RadarCloud, read_radar
from pipeline.ingest.messages.video import VideoPictures, video_codec
from pipeline.ingest.roles import DETECTIONS, LABELS, Role
from pipeline.ingest.sync import Rejection, match_nearest
from pipeline.rig.cameras import Camera
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse, transform_points
from schemas.captures import Capture, Image, Scan, Sweep

__all__ = ["Read", "Rejected", "deskew", "planar_motion", "readers_of"]

_SAME_IMAGE_NS = 5_000_000  # labels and detections have the stamp of the image they were computed from


class Rejected(Exception):  # noqa: N818  # an outcome that is counted, not an error that anyone sees
    """A capture or a moment that is rejected."""

    def __init__(self, reason: Rejection | str, detail: str = "") -> None:
        self.reason, self.detail = reason, detail
        super().__init__(f"{reason}: {detail}" if detail else str(reason))


@dataclass(frozen=True, eq=False)
class Read:
    """A row of a sensor's table, with further values for ingest.

    Args:
        measured: raw measurement, to detect a sensor that repeats itself.
        dropped: number of dropped points by reason.
    """

    capture: Capture
    frame_id: str
    measured: LidarCloud | RadarCloud | bytes
    dropped: Counter[str] = field(default_factory=Counter)


def readers_of(
    index: DayIndex, rig: Rig, ingest: IngestConfig, counts: Counter[str]
) -> dict[str, _Images | _Sweeps | _Scans]:
    """Reader of each sensor of a rig, by name; `counts` collects dropped points and missing parts.

    Its `read(place, moment)` gives the row of a message, by its index in the sensor's stream, or raises Rejected.
    """
    readers: dict[str, _Images | _Sweeps | _Scans] = {}
    for name, camera in rig.cameras.items():
        readers[name] = _Images(_Messages(index, name), camera, counts)
    readers |= {name: _Sweeps(_Messages(index, name), ingest, counts) for name in rig.lidars}
    readers |= {name: _Scans(_Messages(index, name), radar, ingest) for name, radar in rig.radars.items()}
    return readers


class _Messages:
    """The messages of one sensor in a day's index."""

    def __init__(self, index: DayIndex, sensor: str) -> None:
        self.index, self.sensor, self.captures = index, sensor, index.captures(sensor)

    def stamp_ns(self, place: int) -> int:
        """Stamp of a capture [ns]."""
        return self.captures.stamps[place]

    def read(self, located: Located) -> tuple[Any, str]:
        """A decoded message and its frame id."""
        data = self.index.read(located)
        return decode(located.channel, data), header_frame_id(located.channel, data)


class _Images:
    """Images of a camera, with their logged labels and detections."""

    def __init__(self, messages: _Messages, camera: CameraTopics, counts: Counter[str]) -> None:
        self._messages, self._index, self._counts = messages, messages.index, counts
        # If models compute semantics later, frames without logged ones are complete.
        self._logged_semantics = int(isinstance(camera.semantics, TopicSemantics))
        stamps_ns = messages.captures.stamps_ns
        self._video = VideoPictures(self._packet, stamps_ns)
        self._earlier = EarlierImages(
            self._index, messages.sensor, lambda place: self._encoded(place)[0], (LogError, *DECODE_ERRORS)
        )
        self._logged = {}
        for what in (LABELS, DETECTIONS):
            stream = self._index.stream(Role(what, messages.sensor))
            self._logged[what] = stream, match_nearest(stamps_ns, stream.stamps_ns, _SAME_IMAGE_NS)

    def read(self, place: int, moment: int) -> Read:
        stamp_ns = self._messages.stamp_ns(place)
        log = self._messages.captures.located[place].log
        camera = self._index.camera_at(self._messages.sensor, log, stamp_ns)
        if camera is None:
            raise Rejected(Rejection.CAMERA_INFO)
        image, frame_id = self._image(place, camera)
        boxes, classes, scores = self._detections(place, camera, frame_id)
        row = Image(
            moment=moment, stamp_ns=stamp_ns, image=image.data, image_format=image.format,
            image_width_px=camera.width_px, image_height_px=camera.height_px,
            camera_model=camera.model, camera_K=camera.K, camera_D=camera.D, labels_png=self._labels(place),
            detection_boxes_px=boxes, detection_classes=classes, detection_scores=scores,
            **self._earlier.columns(place, image.data),
        )  # fmt: skip
        return Read(row, frame_id, image.data)

    def _image(self, place: int, camera: Camera) -> tuple[EncodedImage, str]:
        try:
            image, frame_id = self._encoded(place)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.IMAGE_DAMAGED, str(err)) from err
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
            sizes = f"{image.width_px}x{image.height_px}, camera_info {camera.width_px}x{camera.height_px}"
            raise Rejected(Rejection.IMAGE_SIZE, sizes)
        return image, frame_id

    def _encoded(self, place: int) -> tuple[EncodedImage, str]:
        """Image of a message, and its frame id."""
        message, frame_id = self._messages.read(self._messages.captures.located[place])
        if not hasattr(message, "format"):
            return encode_raw_image(message), frame_id
        if video_codec(message.format) is not None:
            return encode_pixels(self._video.picture(place)), frame_id
        return inspect_image(bytes(message.data)), frame_id

    def _packet(self, place: int) -> tuple[str, bytes]:
        message, _ = self._messages.read(self._messages.captures.located[place])
        return str(message.format), bytes(message.data)

    def _logged_at(self, what: str, place: int) -> Located | None:
        """Message of type `what` for this image; None if none was logged."""
        stream, partner = self._logged[what]
        if partner[place] < 0:
            self._counts[f"frames_without_{what}"] += self._logged_semantics
            return None
        return stream.located[int(partner[place])]

    def _labels(self, place: int) -> bytes | None:
        located = self._logged_at(LABELS, place)
        if located is None:
            return None
        try:
            return label_image(self._messages.read(located)[0])
        except (LogError, *DECODE_ERRORS) as err:
            self._counts["labels_damaged"] += 1
            self._index.complain(f"labels: {err}")
            return None

    def _detections(
        self, place: int, camera: Camera, camera_frame: str
    ) -> tuple[np.ndarray | None, list[str] | None, np.ndarray | None]:
        located = self._logged_at(DETECTIONS, place)
        if located is None:
            return None, None, None
        try:
            message, _ = self._messages.read(located)
            is_3d = located.channel.msgtype in DETECTIONS_3D
            found = read_detections_3d(message, camera, camera_frame) if is_3d else read_detections(message)
        except (LogError, *DECODE_ERRORS) as err:
            self._counts["detections_damaged"] += 1
            self._index.complain(f"detections: {err}")
            return None, None, None
        boxes, classes, scores, dropped = found
        self._counts["detections_without_box_or_class"] += dropped
        return boxes, classes, scores


class _Sweeps:
    """Sweeps of a lidar, de-skewed to their stamps if the car's motion is known."""

    def __init__(self, messages: _Messages, ingest: IngestConfig, counts: Counter[str]) -> None:
        self._messages, self._index, self._ingest, self._counts = messages, messages.index, ingest, counts

    def read(self, place: int, moment: int) -> Read:
        located, stamp_ns = self._messages.captures.located[place], self._messages.stamp_ns(place)
        try:
            message, frame_id = self._messages.read(located)
            cloud = read_lidar(message, stamp_ns, self._ingest.max_lidar_range_m)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.LIDAR_DAMAGED, str(err)) from err
        if cloud.unit:
            raise Rejected(Rejection.LIDAR_UNIT, f"{cloud.unit} fit, metres are needed")
        if len(cloud.x_m) < self._ingest.min_lidar_points:
            raise Rejected(Rejection.LIDAR_SPARSE, f"{len(cloud.x_m)} points")
        (x, y, z), is_deskewed = self._deskewed(cloud, frame_id, located.log, self._index.ego.at(stamp_ns))
        row = Sweep(
            moment=moment, stamp_ns=stamp_ns, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_intensity=cloud.intensity,
            lidar_ring=cloud.ring, lidar_time_s=cloud.time_s, lidar_deskewed=is_deskewed,
        )  # fmt: skip
        return Read(row, frame_id, cloud, cloud.dropped)

    def _deskewed(
        self, lidar: LidarCloud, frame_id: str, log: int, ego: EgoState | None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], bool]:
        as_logged = lidar.x_m, lidar.y_m, lidar.z_m
        if not self._ingest.deskew or lidar.time_s is None or ego is None:
            return as_logged, False
        T_vehicle_lidar = self._index.trees[log].lookup(self._index.ego.vehicle_frame, frame_id)
        if T_vehicle_lidar is None:
            # Without the lever arm, the convention of the axes (x forward, y left, z up) still gives the
            # direction of travel; the remaining error is yaw rate x lever arm x sweep time, about 2 cm in a
            # city turn.
            self._counts["sweeps_deskewed_without_lever_arm"] += 1
            T_vehicle_lidar = np.eye(4)
        points = np.stack(as_logged, axis=-1)
        x, y, z = deskew(points, lidar.time_s, ego.speed_mps, ego.yaw_rate_radps, T_vehicle_lidar).T
        return (x, y, z), True


class _Scans:
    """Scans of a radar."""

    def __init__(self, messages: _Messages, radar: RadarTopics, ingest: IngestConfig) -> None:
        self._messages, self._radar, self._ingest = messages, radar, ingest

    def read(self, place: int, moment: int) -> Read:
        located = self._messages.captures.located[place]
        try:
            message, frame_id = self._messages.read(located)
            cloud = read_radar(message, located.channel.msgtype, self._radar)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.RADAR_DAMAGED, str(err)) from err
        if cloud.unit:
            raise Rejected(Rejection.RADAR_UNIT, f"{cloud.unit} fit, metres are needed")
        if len(cloud.xyz_m) < self._ingest.min_radar_points:
            raise Rejected(Rejection.RADAR_SPARSE, f"{len(cloud.xyz_m)} points")
        x, y, z = cloud.xyz_m.T
        row = Scan(
            moment=moment, stamp_ns=self._messages.stamp_ns(place), radar_x_m=x, radar_y_m=y, radar_z_m=z,
            radar_range_rate_mps=cloud.range_rate_mps, radar_power_db=cloud.power_db,
            radar_has_elevation=cloud.has_elevation, doppler_period_mps=self._radar.doppler_period_mps,
        )  # fmt: skip
        return Read(row, frame_id, cloud, cloud.dropped)


def deskew(
    points_lidar: Float32[np.ndarray, "N 3"],
    time_s: Float32[np.ndarray, " N"],
    speed_mps: float,
    yaw_rate_radps: float,
    T_vehicle_lidar: Float[np.ndarray, "4 4"],
) -> Float32[np.ndarray, "N 3"]:
    """Points in the lidar frame at the stamp, for a vehicle of constant speed and yaw rate during the sweep.

    Args:
        time_s: of each point, relative to the stamp.
        speed_mps: forward speed of the vehicle frame's origin.
        yaw_rate_radps: positive to the left.
        T_vehicle_lidar: maps lidar coordinates to the vehicle frame (x forward, y left, z up).
    """
    points = transform_points(T_vehicle_lidar, points_lidar.astype(np.float64))
    yaw, shift_x, shift_y = planar_motion(time_s.astype(np.float64), speed_mps, yaw_rate_radps)
    c, s = np.cos(yaw), np.sin(yaw)
    moved = np.stack(
        [
            c * points[:, 0] - s * points[:, 1] + shift_x,
            s * points[:, 0] + c * points[:, 1] + shift_y,
            points[:, 2],
        ],
        -1,
    )
    return transform_points(inverse(T_vehicle_lidar), moved).astype(np.float32)


def planar_motion(
    time_s: Float[np.ndarray, " N"], speed_mps: float, yaw_rate_radps: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Yaw [rad] and position [m] of the vehicle on a circular arc, relative to its pose at time 0."""
    yaw = yaw_rate_radps * time_s
    # sin(a)/a and (1-cos(a))/a through sinc: exact on a straight line too
    half = np.sinc(yaw / (2 * np.pi))
    return yaw, speed_mps * time_s * half * np.cos(yaw / 2), speed_mps * time_s * half * np.sin(yaw / 2)
