"""One synchronised trio to one row of `frames`: only here are payloads decoded, only those of kept trios."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.config import IngestConfig
from pipeline.errors import LogError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import to_quaternion
from pipeline.ingest.deskew import deskew
from pipeline.ingest.index import DayIndex, Located
from pipeline.ingest.messages.decoding import DECODE_ERRORS, decode, header_frame_id
from pipeline.ingest.messages.detections import read_detections
from pipeline.ingest.messages.detections_3d import DETECTIONS_3D, read_detections_3d
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
from pipeline.ingest.sync import Rejection
from pipeline.rigs import Rig, TopicSemantics
from schemas.frames import Frame

__all__ = ["FrameBuilder", "Rejected", "Trio"]


class Rejected(Exception):  # noqa: N818  # an outcome that is counted, not an error that anyone sees
    """A trio that becomes no frame."""

    def __init__(self, reason: Rejection, detail: str = "") -> None:
        self.reason, self.detail = reason, detail
        super().__init__(f"{reason}: {detail}" if detail else str(reason))


@dataclass(frozen=True, slots=True)
class Trio:
    """Places in the streams of a trio and of its image's labels and detections (None where not logged)."""

    camera: int
    lidar: int
    radar: int
    labels: int | None
    detections: int | None
    drive: int


_Prior = tuple[Float[np.ndarray, "4 4"] | None, Float[np.ndarray, "4 4"] | None]


class FrameBuilder:
    """Builds rows from an index. `counts` gathers, by name, dropped points and what frames go without."""

    def __init__(
        self, index: DayIndex, rig: Rig, ingest: IngestConfig, file_prior: _Prior | None = None
    ) -> None:
        self._index, self._rig, self._ingest, self._file_prior = index, rig, ingest, file_prior
        # Where models compute semantics later, frames without logged ones lack nothing.
        self._logged_semantics = int(isinstance(rig.camera.semantics, TopicSemantics))
        self._priors: dict[tuple[int, str, str, str], dict[str, float | None]] = {}
        self._video = VideoPictures(self._image_packet, index.stream("image").stamps_ns)
        self.counts: Counter[str] = Counter()
        self.frame_ids: dict[str, list[str]] = {}

    def build(self, trio: Trio, frame_index: int) -> Frame:
        """The row of a trio.

        Raises:
            Rejected: a part is damaged or says too little; nothing is made up for it.
        """
        image_at, lidar_at, radar_at = (
            self._located("image", trio.camera),
            self._located("lidar", trio.lidar),
            self._located("radar", trio.radar),
        )
        stamp = self._index.stream("lidar").stamps[trio.lidar]
        camera_stamp = self._index.stream("image").stamps[trio.camera]
        camera = self._camera(image_at, camera_stamp)
        image, camera_frame = self._image(trio.camera, camera)
        lidar, lidar_frame = self._lidar(lidar_at, stamp)
        radar, radar_frame = self._radar(radar_at)
        ego = self._index.ego.at(stamp)
        (lidar_x, lidar_y, lidar_z), is_deskewed = self._deskewed(lidar, lidar_frame, lidar_at.log, ego)
        boxes, classes, scores = self._detections(trio, camera, camera_frame)
        prior = self._prior(lidar_at.log, camera_frame, lidar_frame, radar_frame)
        self.counts.update(lidar.dropped + radar.dropped)
        self.counts["frames_without_prior"] += None in prior.values()
        return Frame(
            frame_index=frame_index, log=self._index.log_names[lidar_at.log], drive=trio.drive,
            stamp_ns=stamp, camera_stamp_ns=camera_stamp, lidar_stamp_ns=stamp,
            radar_stamp_ns=self._index.stream("radar").stamps[trio.radar],
            image=image.data, image_format=image.format,
            image_width_px=camera.width_px, image_height_px=camera.height_px,
            camera_model=camera.model, camera_K=camera.K, camera_D=camera.D, labels_png=self._labels(trio),
            detection_boxes_px=boxes, detection_classes=classes, detection_scores=scores,
            lidar_x_m=lidar_x, lidar_y_m=lidar_y, lidar_z_m=lidar_z,
            lidar_intensity=lidar.intensity, lidar_ring=lidar.ring, lidar_time_s=lidar.time_s,
            lidar_deskewed=is_deskewed,
            radar_x_m=radar.xyz_m[:, 0], radar_y_m=radar.xyz_m[:, 1], radar_z_m=radar.xyz_m[:, 2],
            radar_range_rate_mps=radar.range_rate_mps, radar_power_db=radar.power_db,
            radar_has_elevation=radar.has_elevation,
            doppler_period_mps=self._rig.radar.doppler_period_mps,
            ego_speed_mps=None if ego is None else ego.speed_mps,
            ego_yaw_rate_radps=None if ego is None else ego.yaw_rate_radps,
            **_transform_fields("ego_", None if ego is None else ego.T_odom_vehicle),
            **prior,
        )  # fmt: skip

    # -- parts ------------------------------------------------------------

    def _located(self, role: str, i: int) -> Located:
        return self._index.stream(role).located[i]

    def _message(self, located: Located) -> tuple[Any, str]:
        data = self._index.read(located)
        return decode(located.channel, data), header_frame_id(located.channel, data)

    def _camera(self, image_at: Located, stamp_ns: int) -> Camera:
        camera = self._index.camera_at(image_at.log, stamp_ns)
        if camera is None:
            raise Rejected(Rejection.CAMERA_INFO)
        return camera

    def _image(self, place: int, camera: Camera) -> tuple[EncodedImage, str]:
        try:
            message, frame_id = self._message(self._located("image", place))
            if not hasattr(message, "format"):
                image = encode_raw_image(message)
            elif video_codec(message.format) is not None:
                image = encode_pixels(self._video.picture(place))
            else:
                image = inspect_image(bytes(message.data))
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.IMAGE_DAMAGED, str(err)) from err
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
            sizes = f"{image.width_px}x{image.height_px}, camera_info {camera.width_px}x{camera.height_px}"
            raise Rejected(Rejection.IMAGE_SIZE, sizes)
        return image, frame_id

    def _image_packet(self, place: int) -> tuple[str, bytes]:
        message, _ = self._message(self._located("image", place))
        return str(message.format), bytes(message.data)

    def _lidar(self, located: Located, stamp_ns: int) -> tuple[LidarCloud, str]:
        try:
            message, frame_id = self._message(located)
            cloud = read_lidar(message, stamp_ns, self._ingest.max_lidar_range_m)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.LIDAR_DAMAGED, str(err)) from err
        if len(cloud.x_m) < self._ingest.min_lidar_points:
            raise Rejected(Rejection.LIDAR_SPARSE, f"{len(cloud.x_m)} points")
        return cloud, frame_id

    def _radar(self, located: Located) -> tuple[RadarCloud, str]:
        try:
            message, frame_id = self._message(located)
            cloud = read_radar(message, located.channel.msgtype, self._rig.radar)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.RADAR_DAMAGED, str(err)) from err
        if len(cloud.xyz_m) < self._ingest.min_radar_points:
            raise Rejected(Rejection.RADAR_SPARSE, f"{len(cloud.xyz_m)} points")
        return cloud, frame_id

    def _labels(self, trio: Trio) -> bytes | None:
        if trio.labels is None:
            self.counts["frames_without_labels"] += self._logged_semantics
            return None
        try:
            return label_image(self._message(self._located("labels", trio.labels))[0])
        except (LogError, *DECODE_ERRORS) as err:
            self.counts["labels_damaged"] += 1
            self._index.complain(f"labels: {err}")
            return None

    def _detections(
        self, trio: Trio, camera: Camera, camera_frame: str
    ) -> tuple[np.ndarray | None, list[str] | None, np.ndarray | None]:
        if trio.detections is None:
            self.counts["frames_without_detections"] += self._logged_semantics
            return None, None, None
        try:
            located = self._located("detections", trio.detections)
            message, _ = self._message(located)
            is_3d = located.channel.msgtype in DETECTIONS_3D
            found = read_detections_3d(message, camera, camera_frame) if is_3d else read_detections(message)
        except (LogError, *DECODE_ERRORS) as err:
            self.counts["detections_damaged"] += 1
            self._index.complain(f"detections: {err}")
            return None, None, None
        boxes, classes, scores, dropped = found
        self.counts["detections_without_box_or_class"] += dropped
        return boxes, classes, scores

    def _deskewed(
        self, lidar: LidarCloud, frame_id: str, log: int, ego: EgoState | None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], bool]:
        as_logged = lidar.x_m, lidar.y_m, lidar.z_m
        if not self._ingest.deskew or lidar.time_s is None or ego is None:
            return as_logged, False
        T_vehicle_lidar = self._index.trees[log].lookup(self._index.ego.vehicle_frame, frame_id)
        if T_vehicle_lidar is None:
            # Without the lever arm the axes' convention (x forward, y left, z up) still tells the direction
            # of travel; the error left is yaw rate x lever arm x sweep, some 2 cm in a city turn.
            self.counts["sweeps_deskewed_without_lever_arm"] += 1
            T_vehicle_lidar = np.eye(4)
        points = np.stack(as_logged, axis=-1)
        x, y, z = deskew(points, lidar.time_s, ego.speed_mps, ego.yaw_rate_radps, T_vehicle_lidar).T
        return (x, y, z), True

    def _prior(self, log: int, camera: str, lidar: str, radar: str) -> dict[str, float | None]:
        key = (log, camera, lidar, radar)
        if key not in self._priors:
            for role, frame_id in (("camera", camera), ("lidar", lidar), ("radar", radar)):
                known = self.frame_ids.setdefault(role, [])
                known += [] if frame_id in known else [frame_id]
            T_camera_lidar, T_lidar_radar = self._file_prior or self._logged_prior(*key)
            self._priors[key] = _transform_fields("prior_camera_lidar_", T_camera_lidar) | _transform_fields(
                "prior_lidar_radar_", T_lidar_radar
            )
        return self._priors[key]

    def _logged_prior(self, log: int, camera: str, lidar: str, radar: str) -> _Prior:
        tree = self._index.trees[log]
        T_camera_lidar, T_lidar_radar = tree.lookup(camera, lidar), tree.lookup(lidar, radar)
        for T, a, b in ((T_camera_lidar, camera, lidar), (T_lidar_radar, lidar, radar)):
            if T is None:
                names = f"{a or '(no frame id)'} to {b or '(no frame id)'}"
                self._index.complain(f"{self._rig.prior.topic} has no chain from {names}: no prior")
        return T_camera_lidar, T_lidar_radar


def _transform_fields(prefix: str, T: Float[np.ndarray, "4 4"] | None) -> dict[str, float | None]:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = [None] * 7 if T is None else [float(v) for v in (*to_quaternion(T), *T[:3, 3])]
    return {f"{prefix}{n}": v for n, v in zip(names, values, strict=True)}
