"""Assignment of topics to sensors: by types, frame ids, fields and sizes, then by topic names."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import takewhile
from typing import Any

import cv2
import numpy as np

from pipeline.ingest.messages.image import inspect_image, label_image, read_camera_info
from pipeline.ingest.messages.point_cloud import cloud_columns
from pipeline.ingest.messages.video import video_codec
from pipeline.ingest.propose.survey import Survey, Topic
from pipeline.rig.cameras import Camera

__all__ = ["FoundCamera", "FoundCloud", "FoundSensors", "find_sensors"]

# Names that drivers use for the speed along the line of sight; those with "comp" are over ground and useless
# here.
_DOPPLER = (
    "doppler", "doppler_velocity", "dopplervelocity", "range_rate", "rangerate", "radial_velocity", "radial_speed",
    "v_doppler", "v_radial", "v_r", "vr", "velocity", "speed",
)  # fmt: skip
_COMPONENTS = (("vx", "vy", "vz"), ("vx", "vy"), ("v_x", "v_y"), ("velocity_x", "velocity_y"))
_MOST_DETECTIONS = 10_000  # a larger cloud is a lidar's, even with speeds
_MOST_LABELS = 160  # most distinct values of a label image; a grey image has more
_VOID = 255
_VIDEO = (0, 0)  # the size of a video is not in every packet
_SETS = (("cityscapes", 18), ("ade20k", 149))  # largest label other than void


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A camera's topics; `labels_say` describes the label values, "" if there are none."""

    frame_id: str
    image: str
    info: str
    labels: str = ""
    label_set: str = ""
    labels_say: str = ""
    detections: str = ""


@dataclass(frozen=True, eq=False)
class FoundCloud:
    """A lidar or a radar; `doppler` has its field or its components' fields, () for radar message types."""

    frame_id: str
    topic: str
    msgtype: str
    fields: tuple[str, ...] = ()
    doppler: tuple[str, ...] = ()


@dataclass(eq=False)
class FoundSensors:
    """All sensors found, descriptions of the topics not used, and images of cameras left out, by frame id."""

    cameras: list[FoundCamera] = field(default_factory=list)
    lidars: list[FoundCloud] = field(default_factory=list)
    radars: list[FoundCloud] = field(default_factory=list)
    odometry: str = ""
    passed_over: list[str] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)


def find_sensors(survey: Survey) -> FoundSensors:
    """Cameras, lidars and radars in the logs, one for each frame id and kind."""
    found = FoundSensors()
    _find_clouds(survey, found)
    _find_cameras(survey, found)
    odometry = sorted(survey.of("odometry"), key=lambda t: (not _moves(t), -t.messages))
    if odometry:
        found.odometry = odometry[0].name
        found.passed_over += [f"{t.name} (odometry too)" for t in odometry[1:]]
    return found


# -- clouds ----------------------------------------------------------------------------------------------------------


def _find_clouds(survey: Survey, found: FoundSensors) -> None:
    best: dict[tuple[str, str], list[tuple[FoundCloud, float]]] = defaultdict(list)
    for topic in survey.of("radar"):  # types that only radars use
        is_cloud = topic.is_a("lidar")
        columns = [_columns(m) for m in topic.samples] if is_cloud else []
        fields = max((c.dtype.names or () for c in columns), key=len, default=())
        points = float(np.median([len(c) for c in columns])) if columns else 0.0
        if is_cloud and not {"x", "y"} <= set(fields):
            found.passed_over.append(f"{topic.name} (no fields x and y)")
            continue
        doppler = _doppler_of(fields)
        is_radar = not is_cloud or (bool(doppler) and points <= _MOST_DETECTIONS and "ring" not in fields)
        kind = "radar" if is_radar else "lidar"
        cloud = FoundCloud(
            topic.frame_id, topic.name, topic.msgtype, fields, doppler if is_radar and is_cloud else ()
        )
        # Of several clouds of one sensor, choose the one with most fields: raw clouds have rings and times.
        best[kind, topic.frame_id].append((cloud, len(fields) * 1e6 + points))
    for (kind, _), clouds in best.items():
        clouds.sort(key=lambda c: -c[1])
        (found.radars if kind == "radar" else found.lidars).append(clouds[0][0])
        found.passed_over += [f"{c.topic} (second topic of {kind} {c.frame_id})" for c, _ in clouds[1:]]


def _columns(message: Any) -> np.ndarray:
    try:
        return cloud_columns(message)
    except ValueError:
        return np.zeros(0, [("unreadable", "u1")])


def _doppler_of(fields: Sequence[str]) -> tuple[str, ...]:
    by_lower = {name.lower(): name for name in reversed(fields)}
    for name in _DOPPLER:
        if name in by_lower:
            return (by_lower[name],)
    for names in _COMPONENTS:
        if set(names) <= set(by_lower):
            return tuple(by_lower[name] for name in names)
    return ()


# -- cameras ---------------------------------------------------------------------------------------------------------


def _find_cameras(survey: Survey, found: FoundSensors) -> None:
    pictures, labels = dict[Topic, tuple[int, int]](), dict[Topic, np.ndarray]()
    for topic in survey.of("image"):
        values = _label_values(topic) if topic.is_a("labels") else None
        if values is not None:
            labels[topic] = values
        elif (size := _size_px(topic)) is not None:
            pictures[topic] = size
        else:
            found.passed_over.append(f"{topic.name} (no readable image: depth, or damaged)")
    for info in survey.of("info"):
        camera = _camera(info, pictures)
        if camera is None:
            found.passed_over.append(f"{info.name} (no image of its size)")
        elif all(camera.frame_id != other.frame_id for other in found.cameras):
            found.cameras.append(camera)
    of_frame = {c.frame_id: c.image for c in found.cameras}
    for topic in pictures:
        image = of_frame.get(topic.frame_id)
        if image is None:
            found.left_out.setdefault(topic.frame_id, []).append(topic.name)
        elif image != topic.name:
            found.passed_over.append(f"{topic.name} (same camera as {image})")
    found.cameras = [
        _with_semantics(c, found.cameras, labels, survey.of("detections")) for c in found.cameras
    ]


def _camera(info: Topic, pictures: Mapping[Topic, tuple[int, int]]) -> FoundCamera | None:
    """Camera of a CameraInfo: an image of its size and frame with the most similar topic name."""
    camera = next((c for c in map(_intrinsics, info.samples) if c is not None), None)
    if camera is None:
        return None
    size = (camera.width_px, camera.height_px)
    fitting = [t for t, of_size in pictures.items() if of_size in (size, _VIDEO)]
    same = [t for t in fitting if t.frame_id == info.frame_id]
    same = same or [t for t in fitting if _shared(t.name, info.name) > 1]
    if not same:
        return None
    is_straight = not np.any(camera.D)  # a rectified image has no distortion

    def fit(topic: Topic) -> tuple[int, bool, bool]:
        is_rectified = "rect" in topic.name
        return _shared(topic.name, info.name), is_rectified == is_straight, "ompressed" in topic.msgtype

    image = max(same, key=fit)
    return FoundCamera(image.frame_id, image.name, info.name)


def _with_semantics(
    camera: FoundCamera,
    cameras: Sequence[FoundCamera],
    labels: Mapping[Topic, np.ndarray],
    detections: Sequence[Topic],
) -> FoundCamera:
    def of(topics: Iterable[Topic]) -> Topic | None:
        near = [t for t in topics if t.frame_id == camera.frame_id or len(cameras) == 1]
        return max(
            near, key=lambda t: (t.frame_id == camera.frame_id, _shared(t.name, camera.image)), default=None
        )

    label, detection = of(labels), of(detections)
    if label is not None:
        known, say = _label_set(labels[label])
        camera = replace(camera, labels=label.name, label_set=known, labels_say=say)
    return camera if detection is None else replace(camera, detections=detection.name)


def _label_set(values: np.ndarray) -> tuple[str, str]:
    """Smallest known label set that contains all these values, and a description of the values."""
    seen = values[values != _VOID]
    if not len(seen):
        return "cityscapes", "void only"
    name = next((name for name, largest in _SETS if seen.max() <= largest), "")
    return name, f"{len(seen)} labels from {seen.min()} to {seen.max()}"


def _label_values(topic: Topic) -> np.ndarray | None:
    """Values of label images; None if they are pictures."""
    values, areas = set[int](), []
    for message in topic.samples:
        try:
            pixels = cv2.imdecode(np.frombuffer(label_image(message), np.uint8), cv2.IMREAD_UNCHANGED)
        except ValueError:
            return None
        if pixels is None:
            return None
        values |= set(np.unique(pixels).tolist())
        areas.append(_has_areas(pixels))
    return np.array(sorted(values)) if areas and all(areas) and len(values) <= _MOST_LABELS else None


def _has_areas(pixels: np.ndarray) -> bool:
    """Whether most pixels equal their right neighbour: in label images; in grey ones one in ten does."""
    return bool(np.mean(pixels[:, 1:] == pixels[:, :-1]) > 0.8)


def _size_px(topic: Topic) -> tuple[int, int] | None:
    for message in topic.samples:
        if hasattr(message, "width"):
            is_depth = str(message.encoding).lower() in {"16uc1", "32fc1"}
            return None if is_depth else (int(message.width), int(message.height))
        if video_codec(str(message.format)) is not None:
            return _VIDEO
        if "compresseddepth" in str(message.format).lower().replace(" ", ""):
            return None
        try:
            image = inspect_image(bytes(message.data))
        except ValueError:
            continue
        return image.width_px, image.height_px
    return None


def _intrinsics(message: Any) -> Camera | None:
    try:
        return read_camera_info(message)
    except ValueError:
        return None


def _moves(topic: Topic) -> bool:
    """Whether an odometry's twist is ever filled in."""
    return any(abs(m.twist.twist.linear.x) + abs(m.twist.twist.linear.y) > 0 for m in topic.samples)


@cache
def _shared(a: str, b: str) -> int:
    """Number of leading words that two topic names share."""
    words = zip(*(re.split(r"[/_]", name.strip("/")) for name in (a, b)), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], words))
