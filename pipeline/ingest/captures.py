"""One message of a sensor to one row of its table; only payloads of kept moments are decoded.

Each image of a moment has an earlier one of the same camera, some metres of driving before: from the two, perception
finds how the camera moves. Most logs have more images than moments, so the earlier one is read from the log too, and
kept small without colour; if it is the image of an earlier moment, its stamp suffices. Messages are looked at in the
order in which they were logged.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.config import IngestConfig
from pipeline.core.rigs import CameraTopics, RadarTopics, TopicSemantics
from pipeline.ingest.index import DayIndex, Located, Stream
from pipeline.ingest.messages.decoding import DECODE_ERRORS
from pipeline.ingest.messages.detections import DETECTIONS_3D, Detections, read_detections, read_detections_3d
from pipeline.ingest.messages.image import (
    EncodedImage,
    encode_pixels,
    encode_raw_image,
    inspect_image,
    label_image,
)
from pipeline.ingest.messages.point_cloud import read_lidar
from pipeline.ingest.messages.radar import read_radar
from pipeline.ingest.messages.video import VideoPictures, video_codec
from pipeline.ingest.roles import DETECTIONS, LABELS, Role
from pipeline.ingest.sync import Rejection, match_nearest
from pipeline.rig.cameras import Camera
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse, transform_points
from schemas.captures import Capture, Image, Scan, Sweep
from schemas.image_motion import tracking_scale

__all__ = ["EarlierImages", "Read", "Rejected", "deskew", "readers_of"]

T = TypeVar("T")
_FEWEST_POINTS = 10
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
        content: what was measured, without stamps; empty if equal content may be two measurements.
        dropped: number of dropped points by reason.
    """

    capture: Capture
    frame_id: str
    content: tuple[bytes, ...]
    dropped: Counter[str] = field(default_factory=Counter)


def readers_of(
    index: DayIndex, rig: Rig, ingest: IngestConfig, counts: Counter[str]
) -> dict[str, Callable[[int, int], Read]]:
    """For each sensor of a rig, the function that reads one of its messages.

    It gives the row of a message, by its index in the sensor's stream and the number of its moment, or raises
    Rejected. `counts` collects dropped points and missing parts.
    """
    readers: dict[str, Callable[[int, int], Read]] = {}
    for name, camera in rig.cameras.items():
        readers[name] = _Images(index, name, camera, counts).read
    for name in rig.lidars:
        readers[name] = partial(_sweep, index, index.captures(name), ingest, counts)
    for name, radar in rig.radars.items():
        readers[name] = partial(_scan, index, index.captures(name), ingest, radar)
    return readers


class _Images:
    """Images of a camera, with their logged labels and detections."""

    def __init__(self, index: DayIndex, sensor: str, camera: CameraTopics, counts: Counter[str]) -> None:
        self._index, self._sensor, self._counts = index, sensor, counts
        # If models compute semantics later, frames without logged ones are complete.
        self._logged_semantics = int(isinstance(camera.semantics, TopicSemantics))
        self._stream = index.captures(sensor)
        stamps_ns = self._stream.stamps_ns
        self._video = VideoPictures(self._packet, stamps_ns)
        self._earlier = EarlierImages(index, sensor, lambda place: self._encoded(place)[0])
        self._logged = {}
        for what in (LABELS, DETECTIONS):
            stream = index.stream(Role(what, sensor))
            self._logged[what] = stream, match_nearest(stamps_ns, stream.stamps_ns, _SAME_IMAGE_NS)

    def read(self, place: int, moment: int) -> Read:
        stamp_ns = self._stream.stamps[place]
        camera = self._index.camera_at(self._sensor, self._stream.located[place].log, stamp_ns)
        if camera is None:
            raise Rejected(Rejection.CAMERA_INFO)
        image, frame_id = self._image(place, camera)
        labels = self._logged_with(LABELS, place, self._labels)
        found = self._logged_with(DETECTIONS, place, partial(self._boxes, camera, frame_id))
        boxes, classes, scores, dropped = found or (None, None, None, 0)
        self._counts["detections_without_box_or_class"] += dropped
        row = Image(
            moment=moment, stamp_ns=stamp_ns, image=image.data, image_format=image.format,
            image_width_px=camera.width_px, image_height_px=camera.height_px,
            camera_model=camera.model, camera_K=camera.K, camera_D=camera.D, labels_png=labels,
            detection_boxes_px=boxes, detection_classes=classes, detection_scores=scores,
            **self._earlier.columns(place, image.data),
        )  # fmt: skip
        return Read(row, frame_id, (image.data,))

    def _image(self, place: int, camera: Camera) -> tuple[EncodedImage, str]:
        try:
            image, frame_id = self._encoded(place)
        except DECODE_ERRORS as err:
            raise Rejected(Rejection.IMAGE_DAMAGED, str(err)) from err
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
            sizes = f"{image.width_px}x{image.height_px}, camera_info {camera.width_px}x{camera.height_px}"
            raise Rejected(Rejection.IMAGE_SIZE, sizes)
        return image, frame_id

    def _encoded(self, place: int) -> tuple[EncodedImage, str]:
        """Image of a message, and its frame id."""
        message, frame_id = self._index.read(self._stream.located[place])
        if not hasattr(message, "format"):
            return encode_raw_image(message), frame_id
        if video_codec(message.format) is not None:
            return encode_pixels(self._video.picture(place)), frame_id
        return inspect_image(bytes(message.data)), frame_id

    def _packet(self, place: int) -> tuple[str, bytes]:
        message, _ = self._index.read(self._stream.located[place])
        return str(message.format), bytes(message.data)

    def _logged_with(self, what: str, place: int, read: Callable[[Located], T]) -> T | None:
        """What was logged for this image; None (and counted) if it was not, or is damaged."""
        stream, partner = self._logged[what]
        if partner[place] < 0:
            self._counts[f"frames_without_{what}"] += self._logged_semantics
            return None
        try:
            return read(stream.located[int(partner[place])])
        except DECODE_ERRORS as err:
            self._counts[f"{what}_damaged"] += 1
            self._index.complain(f"{what}: {err}")
            return None

    def _labels(self, located: Located) -> bytes:
        return label_image(self._index.read(located)[0])

    def _boxes(self, camera: Camera, camera_frame: str, located: Located) -> Detections:
        message, _ = self._index.read(located)
        is_3d = located.channel.msgtype in DETECTIONS_3D
        return read_detections_3d(message, camera, camera_frame) if is_3d else read_detections(message)


def _sweep(
    index: DayIndex, stream: Stream, ingest: IngestConfig, counts: Counter[str], place: int, moment: int
) -> Read:
    """A sweep of a lidar, de-skewed to its stamp if the car's motion is known."""
    located, stamp_ns = stream.located[place], stream.stamps[place]
    try:
        message, frame_id = index.read(located)
        cloud = read_lidar(message, stamp_ns, ingest.max_lidar_range_m)
    except DECODE_ERRORS as err:
        raise Rejected(Rejection.LIDAR_DAMAGED, str(err)) from err
    if cloud.unit:
        raise Rejected(Rejection.LIDAR_UNIT, f"{cloud.unit} fit, metres are needed")
    if len(cloud.x_m) < ingest.min_lidar_points:
        raise Rejected(Rejection.LIDAR_SPARSE, f"{len(cloud.x_m)} points")
    as_logged, moved = (cloud.x_m, cloud.y_m, cloud.z_m), None
    ego = index.ego.at(stamp_ns) if ingest.deskew else None
    if ego is not None and cloud.time_s is not None:
        T_vehicle_lidar = index.trees[located.log].lookup(index.ego.vehicle_frame, frame_id)
        if T_vehicle_lidar is None:
            # Without the lever arm, the convention of the axes (x forward, y left, z up) still gives the
            # direction of travel; the remaining error is yaw rate x lever arm x sweep time, about 2 cm in a
            # city turn.
            counts["sweeps_deskewed_without_lever_arm"] += 1
            T_vehicle_lidar = np.eye(4)
        points = np.stack(as_logged, axis=-1)
        moved = deskew(points, cloud.time_s, ego.speed_mps, ego.yaw_rate_radps, T_vehicle_lidar)
    x, y, z = as_logged if moved is None else moved.T
    row = Sweep(
        moment=moment, stamp_ns=stamp_ns, lidar_x_m=x, lidar_y_m=y, lidar_z_m=z, lidar_intensity=cloud.intensity,
        lidar_ring=cloud.ring, lidar_time_s=cloud.time_s, lidar_deskewed=moved is not None,
    )  # fmt: skip
    return Read(row, frame_id, tuple(axis.tobytes() for axis in as_logged), cloud.dropped)


def _scan(
    index: DayIndex, stream: Stream, ingest: IngestConfig, radar: RadarTopics, place: int, moment: int
) -> Read:
    """A scan of a radar."""
    located = stream.located[place]
    try:
        message, frame_id = index.read(located)
        cloud = read_radar(message, located.channel.msgtype, radar)
    except DECODE_ERRORS as err:
        raise Rejected(Rejection.RADAR_DAMAGED, str(err)) from err
    if cloud.unit:
        raise Rejected(Rejection.RADAR_UNIT, f"{cloud.unit} fit, metres are needed")
    if len(cloud.xyz_m) < ingest.min_radar_points:
        raise Rejected(Rejection.RADAR_SPARSE, f"{len(cloud.xyz_m)} points")
    x, y, z = cloud.xyz_m.T
    row = Scan(
        moment=moment, stamp_ns=stream.stamps[place], radar_x_m=x, radar_y_m=y, radar_z_m=z,
        radar_range_rate_mps=cloud.range_rate_mps, radar_power_db=cloud.power_db,
        radar_has_elevation=cloud.has_elevation, doppler_period_mps=radar.doppler_period_mps,
    )  # fmt: skip
    # A list of a few objects may come twice.
    content = (cloud.xyz_m.tobytes(), cloud.range_rate_mps.tobytes()) if len(x) >= _FEWEST_POINTS else ()
    return Read(row, frame_id, content, cloud.dropped)


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
    yaw, shift_x, shift_y = _planar_motion(time_s.astype(np.float64), speed_mps, yaw_rate_radps)
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


def _planar_motion(
    time_s: Float[np.ndarray, " N"], speed_mps: float, yaw_rate_radps: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Yaw [rad] and position [m] of the vehicle on a circular arc, relative to its pose at time 0."""
    yaw = yaw_rate_radps * time_s
    # sin(a)/a and (1-cos(a))/a through sinc: exact on a straight line too
    half = np.sinc(yaw / (2 * np.pi))
    return yaw, speed_mps * time_s * half * np.cos(yaw / 2), speed_mps * time_s * half * np.sin(yaw / 2)


_WAY_M, _LEAST_M, _MOST_M = 3.0, 1.0, 6.0
_SPAN_S, _LEAST_S, _MOST_S = 0.3, 0.04, 1.5  # without odometry: 1 to 6 m at 3.5 to 20 m/s
_LATEST_S = 0.6  # likewise
_ANOTHER = 0.3  # what another image costs, in logarithms of the way
_STANDING_MPS = 0.3
_STEPS = 12  # of the integral of odometry
_QUALITY = 92
# Why an image has no earlier one; perception adds its own reasons.
NO_EARLIER, TOO_FAR, STAMPS_JUMP, STANDING, SAME_IMAGE = (
    "no_earlier_image",
    "images_too_far_apart",
    "stamps_jump",
    "standing",
    "same_image_again",
)


def _off(span_s: float, driven_m: float, *, is_kept: bool) -> float:
    """How far an image is from the best one; one that is kept anyway comes first. `driven_m` is NaN if unknown."""
    by_way = np.log(span_s / _SPAN_S) if np.isnan(driven_m) else np.log(abs(driven_m) / _WAY_M)
    return float(abs(by_way)) + (0.0 if is_kept else _ANOTHER)


class EarlierImages:
    """Finds the earlier image of each image of one camera; asked in the order of moments.

    Args:
        picture: reads the image of a message; raises one of DECODE_ERRORS if it is damaged.
    """

    def __init__(self, index: DayIndex, sensor: str, picture: Callable[[int], EncodedImage]) -> None:
        self._index, self._captures, self._picture = index, index.captures(sensor), picture
        self._kept: set[int] = set()  # images of moments

    def columns(self, place: int, now: bytes) -> Mapping[str, Any]:
        """Columns `EarlierColumns` of a message's image, which is then an earlier one of those that follow."""
        found = self._nearest(place)
        self._kept.add(place)
        if isinstance(found, str):
            return {"earlier_missing": found}
        image = None
        if found not in self._kept:
            try:
                earlier = self._picture(found)
            except DECODE_ERRORS:
                return {"earlier_missing": NO_EARLIER}
            if earlier.data == now:
                return {"earlier_missing": SAME_IMAGE}
            image = _small_grey(earlier)
        stamp_ns = self._captures.stamps[found]
        return {"earlier_stamp_ns": stamp_ns, "earlier_image": image, **self._motion(stamp_ns, place)}

    def _nearest(self, place: int) -> int | str:
        """The best earlier image, or why there is none."""
        stamps, located = self._captures.stamps, self._captures.located
        now_ns, found, last_ns, driven_m = stamps[place], dict[int, float](), stamps[place], 0.0
        speed = self._index.ego.motion_at(np.array([now_ns], np.int64))[0][0]
        nearest = np.nan, np.inf
        for k in range(place - 1, -1, -1):
            if located[k].log != located[place].log or now_ns - stamps[k] > _MOST_S * 1e9:
                break
            if stamps[k] >= last_ns:
                return STAMPS_JUMP
            ends = np.array([stamps[k], last_ns], np.int64)
            driven_m += float(self._index.ego.motion_at(ends)[0].mean()) * (last_ns - stamps[k]) * 1e-9
            last_ns = stamps[k]
            span_s = (now_ns - stamps[k]) * 1e-9
            nearest = (driven_m, span_s) if k == place - 1 else nearest
            is_near = span_s <= _LATEST_S if np.isnan(driven_m) else _LEAST_M <= abs(driven_m) <= _MOST_M
            if is_near and span_s >= _LEAST_S:
                found[k] = _off(span_s, driven_m, is_kept=k in self._kept)
        if found:
            return min(found, key=found.__getitem__)
        if abs(speed) < _STANDING_MPS:
            return STANDING
        has_one = place > 0 and located[place - 1].log == located[place].log
        way_m, span_s = nearest
        is_far = span_s > _LATEST_S if np.isnan(way_m) else abs(way_m) > _MOST_M
        return TOO_FAR if has_one and is_far else NO_EARLIER

    def _motion(self, earlier_ns: int, place: int) -> Mapping[str, float]:
        """The car's motion by odometry, from the earlier image to this one; empty if it is not known throughout."""
        stamps = np.linspace(earlier_ns, self._captures.stamps[place], _STEPS + 1).astype(np.int64)
        speed, yaw_rate = self._index.ego.motion_at(stamps)
        if not (np.isfinite(speed).all() and np.isfinite(yaw_rate).all()):
            return {}
        s = (stamps - earlier_ns) * 1e-9
        return {
            "ego_driven_m": float(np.trapezoid(speed, s)),
            "ego_turned_rad": float(np.trapezoid(yaw_rate, s)),
            "ego_turned_by_clock_radps": float(yaw_rate[-1] - yaw_rate[0]),
        }


def _small_grey(image: EncodedImage) -> bytes | None:
    """The image at the size of tracking without colour, as JPEG; None if it cannot be decoded."""
    scale = tracking_scale(image.width_px)
    halved = image.format == "jpeg" and scale < 1
    flag = cv2.IMREAD_REDUCED_GRAYSCALE_2 if halved else cv2.IMREAD_GRAYSCALE
    grey = cv2.imdecode(np.frombuffer(image.data, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None:
        return None
    size = math.ceil(image.width_px * scale), math.ceil(image.height_px * scale)
    if grey.shape != size[::-1]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    ok, blob = cv2.imencode(".jpg", grey, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    assert ok, "OpenCV cannot encode a grey JPEG"
    return bytes(blob)
