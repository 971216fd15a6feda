"""One synchronised moment to one row of `frames`: only here are payloads decoded, only those of kept moments.

A sensor whose payload is damaged, says too little or repeats an earlier one is left out of its moment, which goes on
with the other two where no whole moment within the second before shows the same scene.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

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
from pipeline.ingest.repetition import REPEATED, Repetitions
from pipeline.ingest.sync import Rejection
from pipeline.rig.rig import Rig
from pipeline.rigs import TopicSemantics
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS, pairs_of
from schemas.frames import SAME_SCENE_NS, Frame

__all__ = ["FrameBuilder", "Rejected", "Trio", "lacks_prior"]


class Rejected(Exception):  # noqa: N818  # an outcome that is counted, not an error that anyone sees
    """A trio that becomes no frame."""

    def __init__(self, reason: Rejection, detail: str = "") -> None:
        self.reason, self.detail = reason, detail
        super().__init__(f"{reason}: {detail}" if detail else str(reason))


@dataclass(frozen=True, slots=True)
class Trio:
    """Places in the streams of a trio and of its image's labels and detections (None where not logged).

    Of camera, lidar and radar one may be None: the moment has it not.
    """

    camera: int | None
    lidar: int | None
    radar: int | None
    labels: int | None
    detections: int | None
    drive: int


_Part = TypeVar("_Part", bound=tuple[Any, str])
_NONE_NEAR = {"camera": Rejection.NO_CAMERA, "lidar": Rejection.NO_LIDAR, "radar": Rejection.NO_RADAR}
_NO_IMAGE: dict[str, Any] = {
    "image": b"", "image_format": "", "image_width_px": 0, "image_height_px": 0, "camera_model": "",
    "camera_K": np.full((3, 3), np.nan), "camera_D": np.zeros(0), "labels_png": None,
    "detection_boxes_px": None, "detection_classes": None, "detection_scores": None,
}  # fmt: skip
_NO_POINTS = np.zeros(0, np.float32)
_NO_SWEEP = LidarCloud(_NO_POINTS, _NO_POINTS, _NO_POINTS, None, None, None)
_NO_SCAN = RadarCloud(np.zeros((0, 3), np.float32), _NO_POINTS, None, has_elevation=False)


class FrameBuilder:
    """Builds rows from an index. `counts` gathers, by name, dropped points and what frames go without."""

    def __init__(
        self,
        index: DayIndex,
        rig: Rig,
        ingest: IngestConfig,
        file_prior: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
    ) -> None:
        self._index, self._rig, self._ingest, self._file_prior = index, rig, ingest, file_prior
        # Where models compute semantics later, frames without logged ones lack nothing.
        self._logged_semantics = int(isinstance(rig.semantics, TopicSemantics))
        self._priors: dict[tuple[int, str | None, str | None, str | None], dict[str, float | None]] = {}
        self._video = VideoPictures(self._image_packet, index.stream("image").stamps_ns)
        self.counts: Counter[str] = Counter()
        self.frame_ids: dict[str, list[str]] = {}
        self._repetitions = Repetitions()
        self._whole_ns = -SAME_SCENE_NS  # of the last moment with all sensors

    def build(self, trio: Trio, frame_index: int) -> Frame:
        """The row of a trio; ask in order of time.

        Raises:
            Rejected: a payload is damaged or says too little, and fewer than two sensors are left, or a whole moment
                shows the same; nothing is made up.
        """
        missing: dict[str, Rejected] = {}
        stamp, log = self._moment(trio)
        image = self._part("camera", trio.camera, lambda place: self._image_columns(trio, place), missing)
        swept = self._part("lidar", trio.lidar, lambda place: self._lidar(place, stamp), missing)
        scanned = self._part("radar", trio.radar, self._radar, missing)
        parts = {"camera": image, "lidar": swept, "radar": scanned}
        sensors = [sensor for sensor, part in parts.items() if part is not None]
        logged = {"camera": trio.camera, "lidar": trio.lidar, "radar": trio.radar}
        damaged = [why for sensor, why in missing.items() if logged[sensor] is not None]
        if damaged and (len(sensors) < 2 or stamp - self._whole_ns <= SAME_SCENE_NS):
            raise damaged[0]
        self._whole_ns = self._whole_ns if missing else stamp
        self._count(missing)
        columns, camera_frame = image or (_NO_IMAGE, None)
        lidar, lidar_frame = swept or (_NO_SWEEP, None)
        radar, radar_frame = scanned or (_NO_SCAN, None)
        ego = self._index.ego.at(stamp)
        (lidar_x, lidar_y, lidar_z), is_deskewed = self._deskewed(lidar, lidar_frame, log, ego)
        prior = self._prior(log, camera_frame, lidar_frame, radar_frame)
        self.counts.update(lidar.dropped + radar.dropped)
        self.counts["frames_without_prior"] += lacks_prior(sensors, prior)
        return Frame(
            frame_index=frame_index, log=self._index.log_names[log], drive=trio.drive, sensors=sensors,
            stamp_ns=stamp, lidar_stamp_ns=stamp,
            camera_stamp_ns=self._stamp("image", trio.camera) if image else stamp,
            radar_stamp_ns=self._stamp("radar", trio.radar) if scanned else stamp,
            lidar_x_m=lidar_x, lidar_y_m=lidar_y, lidar_z_m=lidar_z,
            lidar_intensity=lidar.intensity, lidar_ring=lidar.ring, lidar_time_s=lidar.time_s,
            lidar_deskewed=is_deskewed,
            radar_x_m=radar.xyz_m[:, 0], radar_y_m=radar.xyz_m[:, 1], radar_z_m=radar.xyz_m[:, 2],
            radar_range_rate_mps=radar.range_rate_mps, radar_power_db=radar.power_db,
            radar_has_elevation=radar.has_elevation,
            doppler_period_mps=None if self._rig.radar is None else self._rig.radar.doppler_period_mps,
            ego_speed_mps=None if ego is None else ego.speed_mps,
            ego_yaw_rate_radps=None if ego is None else ego.yaw_rate_radps,
            **columns | prior | _transform_fields("ego_", None if ego is None else ego.T_odom_vehicle),
        )  # fmt: skip

    # -- parts ------------------------------------------------------------

    def _part(
        self, sensor: str, place: int | None, read: Callable[[int], _Part], missing: dict[str, Rejected]
    ) -> _Part | None:
        """What a sensor of the rig adds to the moment; None, and why in `missing`, where it adds nothing."""
        try:
            if place is not None:
                part = read(place)
                if self._repetitions.is_new(part[0]):
                    return part
                missing[sensor] = Rejected(REPEATED[sensor])
            elif sensor in self._rig.sensors:
                missing[sensor] = Rejected(_NONE_NEAR[sensor])
        except Rejected as why:
            missing[sensor] = why
        return None

    def _count(self, missing: Mapping[str, Rejected]) -> None:
        """Sensors that the moment goes without, by reason; what a payload's trouble is, is said once."""
        for sensor, why in missing.items():
            name = f"without_{sensor}_{why.reason}"
            self.counts[name] += 1
            if self.counts[name] == 1 and why.detail:
                self._index.complain(str(why))

    def _moment(self, trio: Trio) -> tuple[int, int]:
        """Its stamp [ns], the lidar's or else the radar's, and the number of its log."""
        role, place = ("radar", trio.radar) if trio.lidar is None else ("lidar", trio.lidar)
        assert place is not None, "a moment has a sweep or a scan"
        return self._stamp(role, place), self._located(role, place).log

    def _stamp(self, role: str, place: int | None) -> int:
        assert place is not None, f"asked for the stamp of no {role}"
        return self._index.stream(role).stamps[place]

    def _located(self, role: str, i: int) -> Located:
        return self._index.stream(role).located[i]

    def _message(self, located: Located) -> tuple[Any, str]:
        data = self._index.read(located)
        return decode(located.channel, data), header_frame_id(located.channel, data)

    def _image_columns(self, trio: Trio, place: int) -> tuple[dict[str, Any], str]:
        """The columns of the image and of its semantics, and its frame id."""
        camera = self._index.camera_at(self._located("image", place).log, self._stamp("image", place))
        if camera is None:
            raise Rejected(Rejection.CAMERA_INFO)
        image, frame_id = self._image(place, camera)
        boxes, classes, scores = self._detections(trio, camera, frame_id)
        return {
            "image": image.data, "image_format": image.format,
            "image_width_px": camera.width_px, "image_height_px": camera.height_px,
            "camera_model": camera.model, "camera_K": camera.K, "camera_D": camera.D,
            "labels_png": self._labels(trio),
            "detection_boxes_px": boxes, "detection_classes": classes, "detection_scores": scores,
        }, frame_id  # fmt: skip

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

    def _lidar(self, place: int, stamp_ns: int) -> tuple[LidarCloud, str]:
        try:
            message, frame_id = self._message(self._located("lidar", place))
            cloud = read_lidar(message, stamp_ns, self._ingest.max_lidar_range_m)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.LIDAR_DAMAGED, str(err)) from err
        if cloud.unit:
            raise Rejected(Rejection.LIDAR_UNIT, f"{cloud.unit} fit, metres are needed")
        if len(cloud.x_m) < self._ingest.min_lidar_points:
            raise Rejected(Rejection.LIDAR_SPARSE, f"{len(cloud.x_m)} points")
        return cloud, frame_id

    def _radar(self, place: int) -> tuple[RadarCloud, str]:
        assert self._rig.radar is not None, "only a rig with a radar has scans"
        try:
            located = self._located("radar", place)
            message, frame_id = self._message(located)
            cloud = read_radar(message, located.channel.msgtype, self._rig.radar)
        except (LogError, *DECODE_ERRORS) as err:
            raise Rejected(Rejection.RADAR_DAMAGED, str(err)) from err
        if cloud.unit:
            raise Rejected(Rejection.RADAR_UNIT, f"{cloud.unit} fit, metres are needed")
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
        self, lidar: LidarCloud, frame_id: str | None, log: int, ego: EgoState | None
    ) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], bool]:
        as_logged = lidar.x_m, lidar.y_m, lidar.z_m
        if not self._ingest.deskew or frame_id is None or lidar.time_s is None or ego is None:
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

    def _prior(
        self, log: int, camera: str | None, lidar: str | None, radar: str | None
    ) -> dict[str, float | None]:
        """Columns of the transforms between these frames; None = the moment lacks the sensor."""
        key = (log, camera, lidar, radar)
        if key not in self._priors:
            ids = {"camera": camera, "lidar": lidar, "radar": radar}
            for sensor, frame_id in ids.items():
                if frame_id is not None and frame_id not in self.frame_ids.setdefault(sensor, []):
                    self.frame_ids[sensor].append(frame_id)
            given = self._logged_prior(log, ids) if self._file_prior is None else self._file_prior
            self._priors[key] = {}
            for pair in PAIRS:
                self._priors[key] |= _transform_fields(f"prior_{pair}_", given.get(pair))
        return self._priors[key]

    def _logged_prior(self, log: int, ids: Mapping[str, str | None]) -> dict[str, np.ndarray]:
        """By pair; camera-radar only where the lidar's frame is unknown, for it follows from the other two."""
        found = {}
        for pair in PAIRS:
            a, b = (ids[sensor] for sensor in FRAMES_OF_PAIR[pair])
            if a is None or b is None or (pair == "camera_radar" and ids["lidar"] is not None):
                continue
            T = self._index.trees[log].lookup(a, b)
            if T is None:
                names = f"{a or '(no frame id)'} to {b or '(no frame id)'}"
                self._index.complain(f"{self._rig.prior.topic} has no chain from {names}: no prior")
            else:
                found[pair] = T
        return found


def lacks_prior(sensors: Sequence[str], columns: Mapping[str, object]) -> bool:
    """Whether a moment has two of these sensors of which the columns of frames hold no prior."""
    pairs = [p for p in pairs_of(sensors) if p != "camera_radar" or "lidar" not in sensors]
    return any(columns[f"prior_{pair}_qw"] is None for pair in pairs)


def _transform_fields(prefix: str, T: Float[np.ndarray, "4 4"] | None) -> dict[str, float | None]:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = [None] * 7 if T is None else [float(v) for v in (*to_quaternion(T), *T[:3, 3])]
    return {f"{prefix}{n}": v for n, v in zip(names, values, strict=True)}
