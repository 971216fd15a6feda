"""One moment of a vehicle-day, and its drawing as arrays: dots, strokes, pictures and names.

Axes are those of the car (x forward, y left, z up, metres).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import exp_so3, inverse, transform_points
from pipeline.store.moments import joined, sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_rows
from pipeline.store.views import ingested, perceived
from schemas.captures import Image, Scan, Sweep
from schemas.features import ImageFeatures, ScanFeatures, SweepFeatures
from schemas.moments import MOMENTS, PERCEIVED, Moment, Perceived

__all__ = [
    "AXES", "COLOURS", "PARTS", "STATES", "Dots", "Layer", "Name", "Picture", "Rig", "Shown", "Strokes",
    "count_moments", "layers_of", "read_moment",
]  # fmt: skip

# What can be hidden, in the order of the window's boxes.
PARTS = ("sweeps", "radar", "cameras", "boxes", "names")
COLOURS = {
    "camera": (0.35, 0.65, 1.0),
    "lidar": (0.98, 0.78, 0.25),
    "radar": (0.85, 0.45, 1.0),
}  # red, green, blue
_APPROACHING, _RECEDING = (1.0, 0.33, 0.28), (0.3, 0.75, 1.0)
_ROAD_USER, _OBJECT = (0.25, 1.0, 0.45), (0.2, 0.23, 0.28)
_LOW, _HIGH = np.array([0.22, 0.25, 0.31]), np.array([0.58, 0.62, 0.70])  # of points that no camera sees
_HIGH_M = 5.0  # end of that scale, above the lowest points
_MOVING = 1  # of radar_motion
_ARROW_S = 0.3  # an arrow is as long as the way in this time
_SLOWEST_MPS = 0.5  # slower than this over ground is no motion: Doppler's own scatter
_FRUSTUM_M = 3.0
_GRID = 16  # cells of a picture in each direction, bent as the lens bends them
STATES = ("calibrated", "prior")
# Turns of a sensor by hand are about these axes of the car: x forward, y left, z up.
AXES = {"roll": (1.0, 0.0, 0.0), "pitch": (0.0, 1.0, 0.0), "yaw": (0.0, 0.0, 1.0)}
_LOOKED_AT = 12  # moments, spread over the day, of which the one with most road users is shown


@dataclass(frozen=True, eq=False)
class Rig:
    """Kinds of sensors, T_car_reference (drawing's axes), poses by state (prior, calibrated), status."""

    kinds: Mapping[str, str]
    T_car_reference: Float[np.ndarray, "4 4"]
    poses: Mapping[str, Mapping[str, Float[np.ndarray, "4 4"]]]
    status: Mapping[str, str]

    def placed(
        self, state: str, turned: str | None = None, axis: str = "yaw", angle_rad: float = 0.0
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """T_car_sensor by sensor; one sensor is rotated about an axis of the car through the sensor's origin."""
        placed = {name: self.T_car_reference @ T for name, T in self.poses[state].items()}
        if turned in placed:
            T = placed[turned].copy()
            T[:3, :3] = exp_so3(angle_rad * np.array(AXES[axis])) @ T[:3, :3]
            placed[turned] = T
        return placed


@dataclass(frozen=True, eq=False)
class Shown:
    """A moment: its number and the total, data and features by sensor."""

    number: int
    captures: Mapping[str, Image | Sweep | Scan]
    found: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Dots:
    """Points of one colour each."""

    part: str
    xyz: Float[np.ndarray, "N 3"]
    rgb: Float[np.ndarray, "N 3"]
    size_px: float


@dataclass(frozen=True, eq=False)
class Strokes:
    """Straight lines between two ends each."""

    part: str
    ends: Float[np.ndarray, "N 2 3"]
    rgb: Float[np.ndarray, "N 3"]
    width_px: float


@dataclass(frozen=True, eq=False)
class Picture:
    """An image on a bent surface: corners of triangles, and their image coordinates (0..1, v downwards)."""

    part: str
    xyz: Float[np.ndarray, "V 3"]
    uv: Float[np.ndarray, "V 2"]
    triangles: Int[np.ndarray, "T 3"]
    rgb: UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True, eq=False)
class Name:
    """Text at a position."""

    part: str
    text: str
    xyz: Float[np.ndarray, 3]
    rgb: tuple[float, float, float]


Layer = Dots | Strokes | Picture | Name


@dataclass(frozen=True, eq=False)
class _Eye:
    """A camera at its pose with its picture, at the size of its intrinsics."""

    name: str
    camera: Camera
    T_camera_car: Float[np.ndarray, "4 4"]
    rgb: UInt8[np.ndarray, "H W 3"]
    users_px: Float32[np.ndarray, "B 4"]


def layers_of(shown: Shown, rig: Rig, T_car: Mapping[str, Float[np.ndarray, "4 4"]]) -> list[Layer]:
    """All layers of a moment, at these poses T_car_sensor; a sensor without a pose is left out."""
    eyes = [
        _eye(n, c, shown, T_car[n]) for n, c in shown.captures.items() if isinstance(c, Image) and n in T_car
    ]
    layers: list[Layer] = []
    for name, capture in shown.captures.items():
        T, found = T_car.get(name), shown.found.get(name)
        if T is None:
            continue
        if isinstance(capture, Sweep):
            xyz = transform_points(T, capture.lidar_xyz_m.astype(np.float64))
            layers.append(Dots("sweeps", xyz, colours_seen(xyz, eyes), 2.0))
            if isinstance(found, SweepFeatures):
                layers.append(_boxes(found, T, eyes))
        elif isinstance(capture, Scan):
            layers += _detections(capture, found if isinstance(found, ScanFeatures) else None, T)
    for eye in eyes:
        layers += _frustum(eye)
    ends = [
        np.stack([np.tile(T[:3, 3], (3, 1)), T[:3, 3] + 0.5 * T[:3, :3].T], axis=1) for T in T_car.values()
    ]
    # Axes x, y, z of every sensor in red, green, blue.
    layers.append(Strokes("names", np.concatenate(ends), np.tile(np.eye(3), (len(ends), 1)), 4.0))
    for name in shown.captures:
        if name in T_car:
            words = f"{name} ({rig.status[name]})" if rig.status.get(name) else name
            layers.append(Name("names", words, T_car[name][:3, 3].copy(), COLOURS[rig.kinds[name]]))
    return layers


def colours_seen(xyz: Float[np.ndarray, "N 3"], eyes: list[_Eye]) -> Float[np.ndarray, "N 3"]:
    """Colour of each point in the first camera that sees it; grey by height if none does."""
    low = np.percentile(xyz[:, 2], 2) if len(xyz) else 0.0
    share = np.clip((xyz[:, 2:] - low) / _HIGH_M, 0, 1)
    rgb = _LOW + share * (_HIGH - _LOW)
    for eye in reversed(eyes):
        uv, valid = eye.camera.project(transform_points(eye.T_camera_car, xyz))
        seen = valid & eye.camera.contains(np.where(valid[:, None], uv, -1.0))
        column, row = np.rint(uv[seen]).astype(int).T
        rgb[seen] = eye.rgb[row, column] / 255.0
    return rgb


def _eye(name: str, image: Image, shown: Shown, T_car_camera: np.ndarray) -> _Eye:
    camera, found = camera_of(image), shown.found.get(name)
    bgr = cv2.imdecode(np.frombuffer(image.image, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None, "ingest keeps images that can be decoded"
    size = (camera.width_px, camera.height_px)
    if bgr.shape[1::-1] != size:
        bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    users = found.road_user_boxes_px if isinstance(found, ImageFeatures) else np.zeros((0, 4), np.float32)
    return _Eye(name, camera, inverse(T_car_camera), np.ascontiguousarray(bgr[..., ::-1]), users)


def _detections(scan: Scan, found: ScanFeatures | None, T: Float[np.ndarray, "4 4"]) -> list[Layer]:
    """Detections, with an arrow along the beam for moving ones: over ground if perception has it."""
    radar, speed = scan.radar_xyz_m.astype(np.float64), scan.radar_range_rate_mps.astype(np.float64)
    if found is not None:
        radar = found.radar_xyz_m.astype(np.float64)
        speed = np.where(found.radar_motion == _MOVING, found.radar_residual_mps, 0.0).astype(np.float64)
    xyz = transform_points(T, radar)
    dots = Dots("radar", xyz, np.broadcast_to(COLOURS["radar"], xyz.shape).copy(), 4.0)
    moves = np.abs(speed) > _SLOWEST_MPS
    beam = radar[moves] / np.maximum(np.linalg.norm(radar[moves], axis=1, keepdims=True), 1e-9)
    way = (beam * speed[moves, None] * _ARROW_S) @ T[:3, :3].T
    rgb = np.where(speed[moves, None] < 0, _APPROACHING, _RECEDING)
    # Shafts with two horizontal barbs each.
    tip, aside = xyz[moves] + way, np.cross(way, [0.0, 0.0, 1.0])
    ends = [xyz[moves], *(tip - 0.25 * way + sign * 0.15 * aside for sign in (-1, 1))]
    arrows = np.stack([np.concatenate(ends), np.tile(tip, (3, 1))], axis=1)
    return [dots, Strokes("radar", arrows, np.tile(rgb, (3, 1)), 3.0)]


_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], bool)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1])


def _boxes(found: SweepFeatures, T: Float[np.ndarray, "4 4"], eyes: list[_Eye]) -> Strokes:
    """Boxes around the lidar's clusters; clusters inside a camera's box of a road user are highlighted."""
    low, high = found.lidar_cluster_min_m.astype(np.float64), found.lidar_cluster_max_m.astype(np.float64)
    corners = transform_points(T, np.where(_CORNERS, high[:, None], low[:, None]))
    is_user = np.zeros(len(low), bool)
    for eye in eyes:
        uv, valid = eye.camera.project(transform_points(eye.T_camera_car, corners.mean(axis=1)))
        x0, y0, x1, y1 = eye.users_px.T[:, None]
        u, v = uv[:, :1], uv[:, 1:]
        is_user |= valid & ((u > x0) & (u < x1) & (v > y0) & (v < y1)).any(axis=1)
    rgb = np.where(is_user[:, None], _ROAD_USER, _OBJECT)
    return Strokes("boxes", corners[:, _EDGES].reshape(-1, 2, 3), np.repeat(rgb, len(_EDGES), axis=0), 2.0)


# -- cameras ----------------------------------------------------------------


def _frustum(eye: _Eye) -> list[Layer]:
    """The camera's picture on its own rays, 3 m away, and lines from its origin to the corners."""
    width, height = eye.camera.width_px, eye.camera.height_px
    at = np.stack(np.meshgrid(np.linspace(0, 1, _GRID + 1), np.linspace(0, 1, _GRID + 1)), axis=-1)
    rays = eye.camera.unproject(at * [width - 1, height - 1]) * _FRUSTUM_M
    xyz = transform_points(inverse(eye.T_camera_car), rays.reshape(-1, 3))
    number = np.arange((_GRID + 1) ** 2).reshape(_GRID + 1, _GRID + 1)
    a, b, c, d = (n.reshape(-1) for n in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    # Without pixels that no ray of the lens meets.
    triangles = triangles[np.isfinite(xyz[triangles]).all(axis=(1, 2))]
    rgb = eye.rgb.copy()
    for box in eye.users_px.round().astype(int).tolist():
        colour = tuple(round(255 * c) for c in _ROAD_USER)
        cv2.rectangle(rgb, tuple(box[:2]), tuple(box[2:]), colour, max(2, width // 300))
    picture = Picture("cameras", np.nan_to_num(xyz), at.reshape(-1, 2), triangles, rgb)
    border = xyz[np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])]
    origin = inverse(eye.T_camera_car)[:3, 3]
    sides = np.stack([np.broadcast_to(origin, (4, 3)), border[::_GRID]], axis=1)
    ends = np.concatenate([sides, np.stack([border, np.roll(border, -1, axis=0)], axis=1)])
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return [picture, Strokes("cameras", ends, np.tile(COLOURS["camera"], (len(ends), 1)), 2.0)]


def count_moments(lake: Lake, partition: Partition) -> int:
    """Moments of a vehicle-day; raises ConfigError if the lake has none."""
    manifest = ingested(lake, partition)
    if manifest is None or not manifest.rows:
        problem = f"the lake has no moments of {partition.vehicle} {partition.day}: run `boresight ingest`"
        raise ConfigError("command line", "day", problem)
    return manifest.rows


def read_moment(lake: Lake, partition: Partition, number: int | None = None) -> Shown:
    """One moment with all its sensors; number None = of the moments with most sensors, one with many road users.

    Raises:
        ConfigError: the day has no such moment.
        DamagedError, CollectedError: a file is damaged, or was deleted after its retention.
    """
    count = count_moments(lake, partition)
    chosen = _rich_moment(lake, partition) if number is None else number
    if not 0 <= chosen < count:
        raise ConfigError("command line", "moment", f"{chosen}: the day has moments 0 to {count - 1}")
    [(_, captures)] = joined(lake, MOMENTS, partition, None, [chosen])
    found = next((rows for _, rows in joined(lake, PERCEIVED, partition, None, [chosen])), {}) if (
        perceived(lake, partition) is not None
    ) else {}  # fmt: skip
    return Shown(chosen, captures, found)


def _rich_moment(lake: Lake, partition: Partition) -> int:
    """Of some moments with most sensors, spread over the day, the one with most road users."""
    manifest = perceived(lake, partition)
    schema, kind = (MOMENTS, Moment) if manifest is None else (PERCEIVED, Perceived)
    moments: list[Any] = read_rows(lake, schema, partition, kind)
    if not moments:
        return 0
    most = max(len(m.rows) for m in moments)
    whole = [m.moment for m in moments if len(m.rows) == most]
    if manifest is None:
        return int(whole[len(whole) // 2])
    some = sorted({whole[round(i)] for i in np.linspace(0, len(whole) - 1, _LOOKED_AT)})
    seeing = [name for name, kind in sensors_of(manifest).items() if kind == "camera"]
    seen = joined(lake, PERCEIVED, partition, seeing, some)
    users = {m.moment: sum(len(row.road_user_classes) for row in rows.values()) for m, rows in seen}
    return int(max(some, key=lambda number: users.get(number, 0)))
