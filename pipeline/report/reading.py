"""Data that pages read from a lake: records, findings, and frames, with windows of them that are worth looking at.

People and number plates are made unrecognisable: road users in mosaic.

The mosaic covers pixels of road users' classes and detections, grown by a margin; all of a picture whose camera has
no semantics. A person found by neither segmenter nor detector stays visible; if that must not happen, draw pages
without pictures.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.errors import ConfigError
from pipeline.core.sections import ReportConfig
from pipeline.report.overlays import Extrinsics, Scene, Window
from pipeline.report.residuals import at_pixels, boundary_distance_px
from pipeline.rig.cameras import camera_of
from pipeline.rig.graph import edge_of, edge_order, words_of
from pipeline.rig.se3 import transform_points
from pipeline.store.current import (
    current_poses,
    current_records,
    current_states,
    prior_of,
    transform_of,
)
from pipeline.store.partitions import Lake, Partition, days_after
from pipeline.store.records import last_day, read_last, read_records
from pipeline.store.tables import COLLECTED
from pipeline.store.views import Chosen, frames_of, ingested, observations_of, perceived
from schemas.calibrations import CALIBRATIONS, PAIRS, SENSORS, CalibrationRecord
from schemas.columns import POSE_COLUMNS
from schemas.drift import DRIFT, DriftFinding
from schemas.frames import Frame
from schemas.observations import EDGE_LEFT, EDGE_RIGHT, Observation
from schemas.poses import POSES, PoseRow
from schemas.states import STATES, StateRow

__all__ = [
    "choose_frames",
    "choose_windows",
    "day_poses",
    "day_records",
    "drawn_records",
    "drift_of",
    "fleet_records",
    "has_frames",
    "names_drawn",
    "other_cameras",
    "records_of_day",
    "scene_of",
    "scenes_among",
    "spread_observations",
    "states_of",
    "vehicle_states",
]

_COMPARED = (
    *POSE_COLUMNS, *(f"prior_{name}" for name in POSE_COLUMNS), "covariance", "observable", "determined",
)  # fmt: skip
_FRAMES_LOOKED_AT = 60  # evenly spread; more dots say nothing more
# Cityscapes train ids of person, rider, car, truck, bus, train, motorcycle and bicycle: plates sit on vehicles.
_FIRST_ROAD_USER, _LAST_ROAD_USER = 11, 18
# A face is an eighth of a person's height and a plate a quarter of a car's width (0.5 of 1.8 m): tiles that large show
# neither. Of the image's height, since a nearer road user has larger features; 1/40 of 940 px is 23 px, a face 6 m away
# through the paper's camera.
_TILE_SHARE = 1 / 40
_MARGIN_SHARE = 0.1  # of a box: detectors cut feet and mirrors off
_GROWN_PX = 5  # of the label image: outlines wander by a few


def day_records(lake: Lake, partition: Partition, method: str) -> dict[str, CalibrationRecord]:
    """Current records of a vehicle-day in order of edges; raises ConfigError if there are none."""
    found = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle, day=partition.day)
    records = _by_edge(r for r in found if r.method == method)
    if not records:
        known = sorted({r.method for r in found})
        problem = (
            f"{partition.vehicle} has no {method} record on {partition.day}; the lake has {known or 'none'}"
        )
        raise ConfigError("command line", "day", problem)
    return records


def day_poses(lake: Lake, partition: Partition, records: Mapping[str, CalibrationRecord]) -> list[PoseRow]:
    """Current poses of a vehicle-day, by the method of its records; none for a rig whose sensors are named by kind."""
    methods = {r.method for r in records.values() if {r.parent_frame, r.child_frame} - set(SENSORS)}
    if not methods:
        return []
    found = read_records(lake, POSES, PoseRow, vehicle=partition.vehicle, day=partition.day)
    return [p for p in current_poses(found) if p.method in methods]


def vehicle_states(lake: Lake, vehicle: str, method: str) -> list[StateRow]:
    """What a vehicle should load, by the last audit."""
    states = read_records(lake, STATES, StateRow, vehicle=vehicle)
    return current_states([s for s in states if s.method == method])


def fleet_records(lake: Lake, method: str, window_days: int) -> list[CalibrationRecord]:
    """Current records of the last `window_days` days, with the columns for a comparison with the truth."""
    last = last_day(lake, CALIBRATIONS)
    if last is None:
        return []

    def records_from(first: str | None) -> list[CalibrationRecord]:
        found = read_records(lake, CALIBRATIONS, CalibrationRecord, first=first, columns=_COMPARED)
        return [r for r in found if r.method == method]

    # Another method's records may be newer by more than a window.
    records = records_from(days_after(last, 1 - window_days)) or records_from(None)
    first = days_after(max((r.day for r in records), default=last), 1 - window_days)
    return current_records([r for r in records if r.day >= first])


def records_of_day(
    lake: Lake, method: str, day: str, among: Collection[str]
) -> dict[str, dict[str, CalibrationRecord]]:
    """Current records of some vehicles on a day, whole, by vehicle and edge, in order of edges."""
    by_vehicle: dict[str, list[CalibrationRecord]] = {}
    for record in read_records(lake, CALIBRATIONS, CalibrationRecord, day=day, vehicle=set(among)):
        if record.method == method:
            by_vehicle.setdefault(record.vehicle, []).append(record)
    return {vehicle: _by_edge(own) for vehicle, own in by_vehicle.items()}


def _by_edge(records: Iterable[CalibrationRecord]) -> dict[str, CalibrationRecord]:
    """Current records of a vehicle-day by the name of their edge: its kind, or the names of its sensors."""
    edges = {edge_of(r): r for r in current_records(list(records))}
    return {words_of(edge): edges[edge] for edge in sorted(edges, key=edge_order)}


def drawn_records(
    records: Mapping[str, CalibrationRecord], camera: str | None = None
) -> dict[str, CalibrationRecord]:
    """Records by pair for pictures of one camera, lidar and radar: the first of each kind.

    With `camera`, that camera and its lidar alone.
    """
    chosen: dict[str, CalibrationRecord] = {}
    # Of each kind the sensor that is drawn.
    names: dict[str, str] = {} if camera is None else {"camera": camera, "radar": ""}
    for record in records.values():
        ends = _ends(record)
        if record.pair in PAIRS and all(names.get(kind, name) == name for kind, name in ends.items()):
            chosen[record.pair] = record
            names |= ends
    return chosen


def _ends(record: CalibrationRecord) -> dict[str, str]:
    """Names of an edge's sensors by their kinds."""
    return dict(zip(record.pair.split("_"), (record.parent_frame, record.child_frame), strict=True))


def names_drawn(drawn: Mapping[str, CalibrationRecord]) -> Chosen | None:
    """The sensors of such records by kind; None for a vehicle whose sensors are named camera, lidar and radar."""
    names = {kind: name for record in drawn.values() for kind, name in _ends(record).items()}
    return None if all(kind == name for kind, name in names.items()) else cast("Chosen", names)


def other_cameras(
    records: Mapping[str, CalibrationRecord], drawn: Mapping[str, CalibrationRecord]
) -> list[str]:
    """Cameras with a lidar edge, other than the one that is drawn already."""
    named = [r.parent_frame for r in records.values() if r.pair == "camera_lidar"]
    done = {r.parent_frame for r in drawn.values() if r.pair.startswith("camera")}
    return [name for name in dict.fromkeys(named) if name not in done]


def drift_of(lake: Lake, method: str, vehicle: str) -> list[DriftFinding]:
    """Findings of the last audit about a vehicle."""
    return read_last(lake, DRIFT, DriftFinding, method, vehicle=vehicle)


def states_of(records: Mapping[str, CalibrationRecord]) -> tuple[Extrinsics, Extrinsics] | None:
    """Extrinsics at prior and result; None if no pair has either.

    A pair without a result stays at its prior; one without either is NaN.
    """
    before = {p: T for p, r in records.items() if (T := prior_of(r)) is not None}
    after = before | {p: T for p, r in records.items() if (T := transform_of(r)) is not None}
    unknown = np.full((4, 4), np.nan)
    first, last = (Extrinsics(*(of.get(pair, unknown) for pair in PAIRS)) for of in (before, after))
    return (first, last) if after else None


def has_frames(lake: Lake, partition: Partition) -> bool:
    """Whether the lake still holds the images and sweeps for pictures."""
    found = (ingested(lake, partition), perceived(lake, partition))
    return all(manifest is not None and COLLECTED not in manifest.extra for manifest in found)


def spread_observations(lake: Lake, partition: Partition, chosen: Chosen | None = None) -> list[Observation]:
    """Up to 60 observations of chosen sensors (None = the first of each kind), evenly spread over the day."""
    found = list(observations_of(lake, partition, None, chosen))
    if not found:
        return []
    some = np.unique(np.linspace(0, len(found) - 1, _FRAMES_LOOKED_AT).astype(int))
    return [found[i] for i in some]


def scene_of(frame: Frame, observation: Observation, config: ReportConfig) -> Scene:
    """A frame to be drawn, with hidden road users if fleet.toml requires it."""
    is_hidden = config.road_users == "hidden"
    return Scene(without_road_users(frame, observation) if is_hidden else frame, observation)


def scenes_among(
    lake: Lake,
    partition: Partition,
    observations: Sequence[Observation],
    T_camera_lidar: np.ndarray,
    count: int,
    config: ReportConfig,
    sensors: Chosen | None = None,
) -> list[Scene]:
    """Frames with much content, spread over the given observations with most sensors, read from the lake."""
    most = max((len(o.sensors) for o in observations), default=0)
    observations = [o for o in observations if len(o.sensors) == most]
    chosen = [observations[i] for i in choose_frames(observations, T_camera_lidar, count)]
    rows = [o.frame_index for o in chosen]
    frames = {f.frame_index: f for f in frames_of(lake, partition, rows, sensors)}
    there = [(frames[o.frame_index], o) for o in chosen if o.frame_index in frames]
    return [scene_of(f, o, config) for f, o in there]


def without_road_users(frame: Frame, observation: Observation) -> Frame:
    """The frame with its road users in mosaic; without an image where its bytes are no picture."""
    image = cv2.imdecode(np.frombuffer(frame.image, np.uint8), cv2.IMREAD_COLOR) if frame.image else None
    if image is None:
        return replace(frame, image=b"")
    mask = road_user_mask(observation, (frame.image_width_px, frame.image_height_px))
    height, width = image.shape[:2]
    hidden = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    tile = max(1.0, _TILE_SHARE * height)
    few = (max(1, round(width / tile)), max(1, round(height / tile)))
    mosaic = cv2.resize(
        cv2.resize(image, few, interpolation=cv2.INTER_AREA), (width, height), interpolation=cv2.INTER_NEAREST
    )
    _, encoded = cv2.imencode(".png", np.where(hidden[..., None], mosaic, image))
    return replace(frame, image=encoded.tobytes())


def road_user_mask(observation: Observation, size_px: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels of the full image (width, height) of road users by labels or detections, with a margin.

    All pixels, if nothing was looked for.
    """
    if observation.is_unlabelled:
        return np.ones(size_px[::-1], bool)
    labels: UInt8[np.ndarray, "h w"] | None = cv2.imdecode(
        np.frombuffer(observation.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE
    )
    width, height = size_px
    mask = np.zeros((height, width), np.uint8)
    if labels is not None:
        found = ((labels >= _FIRST_ROAD_USER) & (labels <= _LAST_ROAD_USER)).astype(np.uint8)
        grown = cv2.dilate(found, np.ones((2 * _GROWN_PX + 1,) * 2, np.uint8))
        mask = cv2.resize(grown, size_px, interpolation=cv2.INTER_NEAREST)
    for x0, y0, x1, y1 in observation.road_user_boxes_px.astype(np.float64):
        dx, dy = _MARGIN_SHARE * (x1 - x0), _MARGIN_SHARE * (y1 - y0)
        left, right = (int(np.clip(v, 0, width)) for v in (x0 - dx, np.ceil(x1 + dx)))
        top, bottom = (int(np.clip(v, 0, height)) for v in (y0 - dy, np.ceil(y1 + dy)))
        mask[top:bottom, left:right] = 1
    return mask > 0


_MIN_EDGES = 4  # fewer do not show a silhouette
_WINDOW_RAD, _WINDOW_MIN_PX = 0.12, 72  # 7 deg: two tenths of a degree are then 3 % of the width
# Poles, lights, signs and road users: what has an outline in picture and sweep alike (foliage and fences have not).
_CLEAR_LABELS = (5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18)
_NEAREST_M, _FARTHEST_M = 4.0, 45.0  # nearer fills the window, further is a few pixels
_REACH_RAD = 0.003  # 0.17 deg, as wide as a mask's boundary is uncertain


def choose_frames(observations: Sequence[Observation], T_camera_lidar: np.ndarray, count: int) -> list[int]:
    """Indices of frames with much to see (depth jumps, road users, moving radar clusters), spread over the day."""
    if not observations:
        return []
    score = np.array([_richness(o, T_camera_lidar) for o in observations])
    parts = np.array_split(np.arange(len(observations)), min(count, len(observations)))
    return [int(part[np.argmax(score[part])]) for part in parts]


def choose_windows(observation: Observation, T_camera_lidar: np.ndarray, count: int) -> list[Window]:
    """Windows with many sideways depth jumps of near objects at silhouettes: vehicles, poles, signs.

    Chosen at the calibrated state, so that before and after show the same window. A person must judge the
    agreement.
    """
    uv, weight = _weighted_edges(observation, T_camera_lidar)
    focal_px = camera_of(observation).focal_px[0]
    width = round(min(max(_WINDOW_RAD * focal_px, _WINDOW_MIN_PX), observation.image_width_px / 4))
    size = np.array([width, round(width * 0.62)])
    windows: list[Window] = []
    while len(windows) < count and len(uv) >= _MIN_EDGES:
        inside = (np.abs(uv[:, None, :] - uv[None, :, :]) < size / 2 * 0.8).all(axis=-1) @ weight
        best = int(np.argmax(inside))
        if inside[best] < _MIN_EDGES:
            break
        centre = uv[best]
        windows.append(Window((float(centre[0]), float(centre[1])), (int(size[0]), int(size[1]))))
        free = (np.abs(uv - centre) >= size).any(axis=1)
        uv, weight = uv[free], weight[free]
    return windows


def _richness(observation: Observation, T_camera_lidar: np.ndarray) -> float:
    both = {"camera", "lidar"} <= set(observation.sensors)
    edges = np.maximum(_weighted_edges(observation, T_camera_lidar)[1], 0).sum() if both else 0.0
    users, tracks = len(observation.road_user_boxes_px), len(observation.radar_track_xyz_m)
    return float(2 * np.sqrt(edges) + 3 * min(users, 6) + 3 * min(tracks, 6))


def _weighted_edges(
    observation: Observation, T_camera_lidar: np.ndarray
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
    """Near sideways depth jumps in the image: 1 where a silhouette is close, less than 0 where none is."""
    sideways = np.isin(observation.lidar_edge_side, (EDGE_LEFT, EDGE_RIGHT))
    points = transform_points(T_camera_lidar, observation.lidar_edge_xyz_m[sideways].astype(np.float64))
    camera = camera_of(observation)
    uv, valid = camera.project(points)
    distance = np.linalg.norm(points, axis=1)
    valid &= camera.contains(uv, margin_px=8.0) & (distance > _NEAREST_M) & (distance < _FARTHEST_M)
    uv = uv[valid]
    is_near = (
        at_pixels(boundary_distance_px(observation, _CLEAR_LABELS), observation, uv)
        < _REACH_RAD * camera.focal_px[0]
    )
    return uv, np.where(is_near, 1.0, -0.15)
