"""Which frames and which windows of them are worth looking at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.report.overlays import Window
from pipeline.report.residuals import at_pixels, boundary_distance_px
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import transform_points
from schemas.observations import EDGE_LEFT, EDGE_RIGHT, Observation

__all__ = ["choose_frames", "choose_windows"]

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
