"""One frame's sensors rendered at a guess, for training and inference; without torch, compiled.

Per cell of the camera's grid the nearest point wins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from pipeline.learn.sample.clouds import padded_rows
from pipeline.learn.sample.grid import (
    CAMERA_CHANNELS,
    CLASS_CHANNELS,
    FEATURE_UNITS,
    LIDAR_FEATURES,
    MARK_FLAT,
    MARK_LEAST_SHARE,
    MARKED_POINTS,
    MATCHED_POINTS,
    NEAR_M,
    OBJECT_POINTS,
    RADAR_POINTS,
    Grid,
    NetworkConfig,
)  # fmt: skip
from pipeline.rig.se3 import transform_points
from schemas.training import POINT_IS_EDGE, POINT_IS_GROUND, TrainingRow

__all__ = [
    "NEARNESS_M", "FrameSensors", "frame_sensors", "lidar_features", "mark_strength", "nearest_points",
    "object_points", "painted", "radar_features", "render_frame", "render_lidar",
]  # fmt: skip

_INTENSITY = LIDAR_FEATURES.index("intensity")
_EDGE, _GROUND = LIDAR_FEATURES.index("edge"), LIDAR_FEATURES.index("ground")
NEARNESS_M = 8.0  # nearness = this over the range, at most 2
_MILLIMETRES = 1000.0  # ranges are compared in millimetres
_INDEX_BITS = 20  # up to a million points share a key with their range
# Ground of that many sigmas above what lies beside it is paint, within 10 deg to each side of the cell.
_MARK_SIGMAS, _MARK_WINDOW = 3.0, 51
# Added to a rank in 0..1 to choose points: edges first, then objects. Unequal fractions of a rank's step, so that no
# two scores are the same and all machines pick the same points.
_EDGE_BONUS, _OBJECT_BONUS = 1.0 + 2.0**-19, 0.5 + 2.0**-18
_GROUND_WEIGHT = 0.3  # ground is most of the points, and its classes are the least sharp
_MARGIN_DEG = 8.0  # beyond the grid's border: for guesses that are wrong


@dataclass(frozen=True, eq=False)
class FrameSensors:
    """One frame of `network.views.SensorInputs`, without the padding."""

    camera: Float32[np.ndarray, "4 H W"]
    lidar_xyz_m: Float32[np.ndarray, "N 3"]
    lidar_features: Float32[np.ndarray, "N 4"]
    radar_xyz_m: Float32[np.ndarray, "M 3"]
    radar_features: Float32[np.ndarray, "M 3"]
    radar_has_elevation: bool
    classes: Float32[np.ndarray, "C H W"] | None = None  # None: nobody says

    def camera_channels(self, count: int) -> Float32[np.ndarray, "1 C H W"]:
        """The graph's input `camera` of so many channels: the image alone, or the image and its classes."""
        if count == CAMERA_CHANNELS:
            return self.camera[None]
        classes = self.classes
        if classes is None:
            classes = np.zeros((CLASS_CHANNELS, *self.camera.shape[1:]), np.float32)
        return np.concatenate([self.camera, classes])[None]

    def without_image(self) -> FrameSensors:
        """A copy with a grey image: visibility stays, colours are removed."""
        camera = self.camera.copy()
        camera[:-1] = 0
        return replace(self, camera=camera)


def frame_sensors(
    row: TrainingRow, grid: Grid, classes: Float32[np.ndarray, "C H W"] | None = None
) -> FrameSensors:
    """Inputs from a row of table `training`; raises ValueError if its grid does not contain the network's.

    `classes` is the likelihood of a segmenter's classes on the grid (`frame_sample.class_likelihood`), or None.
    """
    shape = (row.grid_height, row.grid_width)
    part = grid.window(shape, row.grid_step_deg)
    image = row.image.reshape(3, *shape)[:, *part] / np.float32(255)
    seen = row.grid_seen.reshape(shape)[part].astype(np.float32)
    camera = np.concatenate([image, seen[None]]).astype(np.float32)
    lidar = row.lidar_xyz_m[: row.lidar_count].astype(np.float32), lidar_features(row)
    radar = row.radar_xyz_m[: row.radar_count].astype(np.float32), radar_features(row)
    return FrameSensors(camera, *lidar, *radar, bool(row.radar_has_elevation), classes)


def lidar_features(row: TrainingRow) -> Float32[np.ndarray, "N 4"]:
    """LIDAR_FEATURES of a row's points, without the padding."""
    count = row.lidar_count
    flags = row.lidar_flags[:count]
    height = _heights(row.lidar_xyz_m[:count].astype(np.float32), row.ground_plane)
    measured = row.lidar_intensity[:count] / np.float32(255), height / np.float32(FEATURE_UNITS["height"])
    features = [*measured, (flags & POINT_IS_EDGE) > 0, (flags & POINT_IS_GROUND) > 0]
    return np.stack(features, -1).astype(np.float32)


def radar_features(row: TrainingRow) -> Float32[np.ndarray, "M 3"]:
    """RADAR_FEATURES of a row's detections, without the padding."""
    count = row.radar_count
    features = [
        np.minimum(np.abs(row.radar_residual_mps[:count]) / FEATURE_UNITS["speed"], 2.0),
        np.clip(row.radar_power_db[:count] / FEATURE_UNITS["power"], -2.0, 2.0),
        row.radar_motion[:count] == 1,
    ]
    return np.stack(features, -1).astype(np.float32)


def render_frame(
    sensors: FrameSensors, guess: Mapping[str, Float[np.ndarray, "4 4"]], config: NetworkConfig
) -> dict[str, np.ndarray]:
    """Inputs of the exported graph by name, batch 1, at a guess of every pair."""
    radar_camera = transform_points(guess["camera_radar"], sensors.radar_xyz_m).astype(np.float32)
    radar_lidar = transform_points(guess["lidar_radar"], sensors.radar_xyz_m).astype(np.float32)
    count = min(len(radar_camera), RADAR_POINTS)
    lidar, _ = render_lidar(
        sensors.lidar_xyz_m, sensors.lidar_features, guess["camera_lidar"], config.grid, marks=config.marks
    )
    return {
        "camera": sensors.camera_channels(config.camera_channels),
        **{name: values[None] for name, values in lidar.items()},
        "radar_grid": painted(radar_camera, sensors.radar_features, config.grid)[0][None],
        "radar_lidar": padded_rows(radar_lidar[:count], RADAR_POINTS)[None],
        "radar_camera": padded_rows(radar_camera[:count], RADAR_POINTS)[None],
        "radar_features": padded_rows(sensors.radar_features[:count], RADAR_POINTS)[None],
        "radar_valid": padded_rows(np.ones(count, bool), RADAR_POINTS)[None],
        "radar_has_elevation": np.array([sensors.radar_has_elevation]),
    }


def render_lidar(
    xyz_m: Float32[np.ndarray, "N 3"], features: Float32[np.ndarray, "N 4"],
    T_camera_lidar: Float[np.ndarray, "4 4"], grid: Grid, *, marks: bool = True, nearness: float = 1.0,
) -> tuple[dict[str, np.ndarray], Int32[np.ndarray, " HW"]]:  # fmt: skip
    """A sweep's inputs of the graph by name, and the point of each cell, -1 in empty ones.

    Without `marks` those of bright ground are empty. `nearness` multiplies the rendered nearness (training looks
    at frames as if they were farther or nearer).
    """
    lidar_camera = transform_points(T_camera_lidar, xyz_m).astype(np.float32)
    edge, ground = features[:, _EDGE], features[:, _GROUND]
    in_view = _in_view(lidar_camera, grid)
    rank, solid = _importance(len(lidar_camera)), _solid(lidar_camera, features, in_view)
    matched = _best(rank + _EDGE_BONUS * edge + _OBJECT_BONUS * (1 - ground), in_view, MATCHED_POINTS)
    weight = np.where(ground > 0.5, np.float32(_GROUND_WEIGHT), np.float32(1))
    cells, index = painted(lidar_camera, features, grid, nearness)
    strength, marked = _marks(cells, index) if marks else (np.zeros(0, np.float32), index[:0])
    return {
        "lidar_grid": cells,
        "points_camera": padded_rows(lidar_camera[matched], MATCHED_POINTS),
        "point_weight": padded_rows(weight[matched], MATCHED_POINTS),
        "objects": padded_rows(xyz_m[solid], OBJECT_POINTS),
        "object_weight": padded_rows(np.ones(len(solid), np.float32), OBJECT_POINTS),
        "marks_camera": padded_rows(lidar_camera[marked], MARKED_POINTS),
        "mark_weight": padded_rows(strength, MARKED_POINTS),
    }, index


def object_points(
    sensors: FrameSensors, T_camera_lidar: Float[np.ndarray, "4 4"], grid: Grid
) -> Float32[np.ndarray, "L 3"]:
    """The sweep's points off the ground in the camera's view, as a graph gets them [m]."""
    lidar_camera = transform_points(T_camera_lidar, sensors.lidar_xyz_m).astype(np.float32)
    return sensors.lidar_xyz_m[_solid(lidar_camera, sensors.lidar_features, _in_view(lidar_camera, grid))]


def _solid(lidar_camera: np.ndarray, features: np.ndarray, in_view: np.ndarray) -> Int64[np.ndarray, " L"]:
    return _best(_importance(len(lidar_camera)), in_view & (features[:, _GROUND] < 0.5), OBJECT_POINTS)


def nearest_points(points_camera: Float[np.ndarray, "N 3"], grid: Grid) -> Int32[np.ndarray, " HW"]:
    """Index of the nearest point in each cell (row by row), -1 in empty cells."""
    out = np.full(grid.height * grid.width, -1, np.int32)
    limits = np.radians([grid.top_deg, grid.left_deg, grid.cell_deg]).astype(np.float32)
    points = np.ascontiguousarray(points_camera, dtype=np.float32)
    _nearest(points, limits, grid.height, grid.width, out)
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _nearest(points, limits, height, width, out):  # noqa: ANN001, ANN202 - compiled
    best = np.full(height * width, np.iinfo(np.int64).max, np.int64)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if z <= NEAR_M:
            continue
        flat = np.sqrt(x * x + z * z)
        row = (limits[0] - np.arctan(-y / flat)) / limits[2]
        column = (limits[1] - np.arctan(-x / z)) / limits[2]
        if row < 0 or column < 0 or row >= height or column >= width:
            continue
        cell = np.int64(row) * width + np.int64(column)
        millimetres = np.int64(np.sqrt(flat * flat + y * y) * np.float32(_MILLIMETRES))
        key = (millimetres << _INDEX_BITS) | n
        if key < best[cell]:
            best[cell] = key
            out[cell] = n


def painted(
    points_camera: Float32[np.ndarray, "N 3"], features: Float32[np.ndarray, "N F"], grid: Grid,
    nearness: float = 1.0,
) -> tuple[Float32[np.ndarray, "C H W"], Int32[np.ndarray, " HW"]]:  # fmt: skip
    """Of a sweep or scan: occupied, nearness and features of the points that won their cells; and these points."""
    index = nearest_points(points_camera, grid)
    out = np.zeros((2 + features.shape[1], len(index)), np.float32)
    full = np.flatnonzero(index >= 0)
    winners = index[full]
    distance = np.maximum(np.linalg.norm(points_camera[winners], axis=1), np.float32(NEAR_M))
    out[0, full] = 1
    out[1, full] = np.minimum(np.float32(nearness * NEARNESS_M) / distance, 2)
    out[2:, full] = features[winners].T
    return out.reshape(-1, grid.height, grid.width), index


def mark_strength(sweep: Float32[np.ndarray, "6 H W"]) -> Float32[np.ndarray, "H W"]:
    """Contrast of each cell's ground with its neighbours in the row: 0 up to one sigma, 1 from _MARK_SIGMAS on.

    Zero everywhere if no reflectivity is logged.
    """
    ground, intensity = sweep[0] * sweep[2 + _GROUND], sweep[2 + _INTENSITY]
    share = np.maximum(_row_sums(ground), MARK_LEAST_SHARE * _MARK_WINDOW)
    above = (intensity - _row_sums(intensity * ground) / share) * ground
    spread = np.sqrt((above * above).sum() / max(ground.sum(), 1.0)) + MARK_FLAT
    return np.clip((above / spread - 1) / (_MARK_SIGMAS - 1), 0, 1).astype(np.float32)


def _marks(sweep: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strength and points of the brightest ground, brightest first."""
    strength = mark_strength(sweep).ravel()
    cells = np.flatnonzero(strength)
    cells = cells[np.argsort(-strength[cells], kind="stable")][:MARKED_POINTS]
    return strength[cells], index[cells]


def _row_sums(values: np.ndarray) -> np.ndarray:
    """Sums over _MARK_WINDOW columns about each, as if beyond the grid there were zeros."""
    half, width = _MARK_WINDOW // 2, values.shape[1]
    total = np.zeros((len(values), width + 1))
    np.cumsum(values, axis=1, out=total[:, 1:])
    column = np.arange(width)
    return total[:, np.minimum(column + half + 1, width)] - total[:, np.maximum(column - half, 0)]


def _heights(xyz: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Height over the ground plane [m], or over the frame's lowest points without a plane (zeros)."""
    if np.linalg.norm(plane[:3]) > 0.5:
        height = xyz @ plane[:3].astype(np.float32) + np.float32(plane[3])
    else:
        z = xyz[:, 2]
        # The 2 % quantile stands for the ground: reflections from below it are rare.
        height = z - (np.sort(z)[int(np.float32(len(z)) * np.float32(0.02))] if len(z) else 0)
    return np.clip(height, -5, 30)


def _in_view(points_camera: np.ndarray, grid: Grid) -> Bool[np.ndarray, " N"]:
    x, y, z = points_camera.T
    flat = np.sqrt(x * x + z * z)
    side = np.tan(np.radians(grid.left_deg + _MARGIN_DEG))
    up, down = np.tan(np.radians([grid.top_deg + _MARGIN_DEG, grid.bottom_deg - _MARGIN_DEG]))
    return (z > NEAR_M) & (np.abs(x) < side * z) & (-y < up * flat) & (-y > down * flat)


@lru_cache(maxsize=4)
def _importance(count: int) -> Float32[np.ndarray, " N"]:
    """A fixed irregular number in 0..1 per row: picks points evenly, and the same ones on every machine."""
    knuth = (np.arange(count, dtype=np.int64) * 2654435761) % 65536  # his multiplicative hash
    return knuth.astype(np.float32) / np.float32(65536)


def _best(score: np.ndarray, allowed: np.ndarray, count: int) -> np.ndarray:
    """Allowed rows of the highest scores, highest first."""
    rows = np.flatnonzero(allowed)
    score = -score[rows].astype(np.float32)
    if len(rows) > count:
        keep = np.argpartition(score, count - 1)[:count]
        rows, score = rows[keep], score[keep]
    return rows[np.argsort(score, kind="stable")]
