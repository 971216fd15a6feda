"""Agreement of the sensors in each frame, before and after calibration; for readers, not for the verdict.

A low residual does not prove accuracy: a calibration can be repeatable, have the best fit and still be
wrong. The verdict depends on held-out frames, checks and sigmas (pipeline.calibrate.verify). The numbers
of this module can be compared with the pictures.

Between sweep, image and scan of a frame, the car moves. The time is the gap of the frame's stamps plus the
offset of the clocks. At 15 m/s, 30 ms are half a metre: without offsets, pictures of a calibration look
worse than it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from pipeline.report.overlays import Extrinsics
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import exp_so3, from_rotation_translation, transform_points
from schemas.calibrations import CalibrationRecord, pairs_of
from schemas.observations import EDGE_LEFT, EDGE_RIGHT, STEP_RIGHT, Observation

__all__ = [
    "MEASURES",
    "TimeOffsets",
    "as_stamped",
    "at_pixels",
    "boundary_distance_px",
    "frame_residuals",
    "time_offsets_of",
]

# pair -> measured quantity; more is better
MEASURES = {
    "camera_lidar": "lidar edges on a silhouette [%]",
    "camera_radar": "moving radar inside a road user's box [%]",
    "lidar_radar": "static radar within 0.3 m of a lidar structure [%]",
}
_ON_SILHOUETTE_RAD = 0.003  # 0.17 deg, as wide as a mask's boundary is uncertain
# Nearer the car's own body is seen, further the lidar has gaps wider than a degree of radar yaw.
_STRUCTURE_FROM_M, _STRUCTURE_TO_M, _ON_STRUCTURE_M = 5.0, 40.0, 0.3
_STATIC, _MOVING = 0, 1
_MIN_POINTS = 5  # shares of fewer say nothing


@dataclass(frozen=True)
class TimeOffsets:
    """Time [s] to add to a child's stamp to convert it to the parent's clock; None = unknown, drawn as simultaneous."""

    camera_lidar_s: float | None = None
    lidar_radar_s: float | None = None

    def in_words(self) -> str:
        """Text with both offsets in milliseconds; empty if neither is known."""
        known = (("camera", self.camera_lidar_s), ("radar", self.lidar_radar_s))
        return ", ".join(f"{sensor} {1e3 * dt_s:+.0f} ms" for sensor, dt_s in known if dt_s)


def frame_residuals(
    observations: Sequence[Observation], states: Sequence[Extrinsics], offsets: Sequence[TimeOffsets] = ()
) -> list[dict[str, Float[np.ndarray, " F"]]]:
    """Measures of MEASURES per state, pair and frame; NaN for a frame with too little data.

    `offsets` are the states' time offsets; without them all are 0.
    """
    offsets = offsets or [TimeOffsets()] * len(states)
    values = np.full((len(states), len(MEASURES), len(observations)), np.nan)
    for f, observation in enumerate(observations):
        there = pairs_of(observation.sensors)
        boundary = boundary_distance_px(observation)
        for s, (unmoved, offset) in enumerate(zip(states, offsets, strict=True)):
            state = as_stamped(unmoved, observation, offset)
            if "camera_lidar" in there:
                values[s, 0, f] = _on_silhouette(observation, boundary, state.T_camera_lidar)
            if "camera_radar" in there:
                values[s, 1, f] = _in_boxes(observation, state.T_camera_radar)
            if "lidar_radar" in there:
                values[s, 2, f] = _on_structure(observation, state.T_lidar_radar)
    return [dict(zip(MEASURES, of_state, strict=True)) for of_state in values]


def boundary_distance_px(observation: Observation, only: Sequence[int] = ()) -> Float[np.ndarray, "H W"]:
    """Distance of each label pixel to the nearest horizontal change of label [full-image px], or inf.

    One of the labels `only` must be at the change; empty = any label. Without labels: to the nearest step of
    brightness.
    """
    change = _steps(observation) if observation.is_unlabelled else _changes(observation, only)
    if not change.any():
        return np.full(change.shape, np.inf)
    return cv2.distanceTransform((~change).astype(np.uint8), cv2.DIST_L2, 3) / float(observation.label_scale)


def at_pixels(
    label_map: Float[np.ndarray, "H W"], observation: Observation, uv: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Values of a map of label size, looked up at full-image pixels; outside the image, the nearest value."""
    at = np.round((uv + 0.5) * observation.label_scale - 0.5).astype(int)
    column, row = (np.clip(at[:, k], 0, label_map.shape[1 - k] - 1) for k in (0, 1))
    return label_map[row, column].astype(np.float64)


def _changes(observation: Observation, only: Sequence[int]) -> Bool[np.ndarray, "H W"]:
    labels = _decoded(observation.labels_png)
    change = np.zeros(labels.shape, bool)
    change[:, 1:] = labels[:, 1:] != labels[:, :-1]
    if only:
        chosen = np.isin(labels, only)
        change[:, 1:] &= chosen[:, 1:] | chosen[:, :-1]
    return change


def _steps(observation: Observation) -> Bool[np.ndarray, "H W"]:
    steps = _decoded(observation.steps_png or b"")
    change = np.zeros(steps.shape, bool)
    change[:, 1:] = (steps[:, :-1] & STEP_RIGHT) > 0
    return change


def _decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE) if png else None
    return np.zeros((1, 1), np.uint8) if image is None else image


def _on_silhouette(observation: Observation, boundary: np.ndarray, T_camera_lidar: np.ndarray) -> float:
    sideways = np.isin(observation.lidar_edge_side, (EDGE_LEFT, EDGE_RIGHT))
    camera = camera_of(observation)
    uv, valid = camera.project(_seen_from(T_camera_lidar, observation.lidar_edge_xyz_m[sideways]))
    uv = uv[valid & camera.contains(uv, margin_px=2.0)]
    if len(uv) < _MIN_POINTS:
        return float("nan")
    return float(
        100 * np.mean(at_pixels(boundary, observation, uv) < _ON_SILHOUETTE_RAD * camera.focal_px[0])
    )


def _in_boxes(observation: Observation, T_camera_radar: np.ndarray) -> float:
    moving = observation.radar_xyz_m[(observation.radar_motion == _MOVING) & (observation.radar_cluster >= 0)]
    camera, boxes = camera_of(observation), observation.road_user_boxes_px.astype(np.float64)
    uv, valid = camera.project(_seen_from(T_camera_radar, moving))
    uv = uv[valid & camera.contains(uv)]
    if len(uv) < _MIN_POINTS or not len(boxes):
        return float("nan")
    inside = (uv[:, None, :] >= boxes[None, :, :2]) & (uv[:, None, :] <= boxes[None, :, 2:])
    return float(100 * inside.all(axis=-1).any(axis=1).mean())


def _on_structure(observation: Observation, T_lidar_radar: np.ndarray) -> float:
    static = _seen_from(T_lidar_radar, observation.radar_xyz_m[observation.radar_motion == _STATIC])
    reach = np.hypot(static[:, 0], static[:, 1])
    static = static[(reach > _STRUCTURE_FROM_M) & (reach < _STRUCTURE_TO_M)]
    standing = observation.lidar_map_xyz_m[observation.lidar_map_is_ground == 0]
    if min(len(static), len(standing)) < _MIN_POINTS:
        return float("nan")
    # From above: most radars measure elevation ten times worse than azimuth.
    distance, _ = cKDTree(standing[:, :2]).query(static[:, :2])
    return float(100 * np.mean(distance < _ON_STRUCTURE_M))


def _seen_from(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return transform_points(T, points.astype(np.float64))


def time_offsets_of(records: Mapping[str, CalibrationRecord]) -> TimeOffsets:
    """The estimated offsets of a run, by pair; None if a method or a day has no estimate."""
    offset_s = {pair: r.time_offset_s for pair, r in records.items()}
    return TimeOffsets(offset_s.get("camera_lidar"), offset_s.get("lidar_radar"))


def as_stamped(state: Extrinsics, observation: Observation, offsets: TimeOffsets) -> Extrinsics:
    """Transforms between data of one frame, for static objects: poses and the car's motion over the offsets.

    T_camera_radar is not changed, because it is used for moving clusters only.
    """
    v, yaw_rate = _velocity_lidar(state, observation), observation.ego_yaw_rate_radps or 0.0
    camera_gap_s, radar_gap_s = (
        (stamp - observation.stamp_ns) * 1e-9
        for stamp in (observation.camera_stamp_ns, observation.radar_stamp_ns)
    )
    image_s = 0.0 if offsets.camera_lidar_s is None else offsets.camera_lidar_s - camera_gap_s
    sweep_s = 0.0 if offsets.lidar_radar_s is None else offsets.lidar_radar_s + radar_gap_s
    to_image, to_sweep = (_way(v, yaw_rate, way_s) for way_s in (image_s, sweep_s))
    return Extrinsics(state.T_camera_lidar @ to_image, state.T_camera_radar, to_sweep @ state.T_lidar_radar)


def _way(
    velocity_mps: Float[np.ndarray, " 3"], yaw_rate_radps: float, dt_s: float
) -> Float[np.ndarray, "4 4"]:
    """Transform of static points to their lidar coordinates dt earlier, p' = Rz(yaw_rate dt) (p + v dt)."""
    R = exp_so3(np.array([0.0, 0.0, yaw_rate_radps * dt_s]))
    return from_rotation_translation(R, R @ velocity_mps * dt_s)


def _velocity_lidar(state: Extrinsics, observation: Observation) -> Float[np.ndarray, " 3"]:
    """Own velocity in lidar axes: the radar's heading, level; straight ahead without a radar velocity."""
    speed_mps = observation.ego_speed_mps or 0.0
    ahead = np.array([1.0, 0.0, 0.0])
    if observation.radar_velocity_mps is not None and speed_mps:
        v = state.T_lidar_radar[:3, :3] @ observation.radar_velocity_mps * np.sign(speed_mps)
        ahead = np.array([v[0], v[1], 0.0]) / max(float(np.hypot(v[0], v[1])), 1e-9)
    return speed_mps * ahead
