"""The paper's signs of misalignment (section 4.5.2), measured at any calibration, and the decision to calibrate.

Counts are means per frame: the paper has sums over an unstated number of frames, and
a sum over a day exceeds 1 for every calibration. A dynamic detection is a moving cluster that the tracker has
seen before, within the paper's 80 m: a cluster of a single scan may be noise. "The entire point cloud" is
what lies in the image: the paper's lidar sees less than its camera, a 360 deg lidar would drown what is
misplaced.

How they react on simulated days of the paper's rig: the camera's two metrics grow by half or more with 1 deg,
the lidar's boxes with 1 deg of pitch only. The drivable metric measures how far the radar's free space falls
short of the lidar's (behind parked cars, 8 % to 47 %), hardly its turn; at 1 % it fires at the truth as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.core.config import TriggerConfig
from pipeline.objective.paper.camera_lidar import cluster_points
from pipeline.objective.paper.classes import REFLECTING, camera_at_label_size, labels_of
from pipeline.objective.paper.lidar_radar import CELL_M, FAR_M, drivable_map
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import inverse, transform_points
from schemas.calibrations import pairs_of
from schemas.observations import Observation

__all__ = ["THRESHOLDS", "exceeded", "trigger_metrics"]

# Metric of each pair -> the threshold of the same name in TriggerConfig.
THRESHOLDS: dict[str, tuple[str, ...]] = {
    "camera_lidar": ("lidar_outside_fraction",),
    "camera_radar": ("radar_outside_image",),
    "lidar_radar": ("radar_outside_lidar", "drivable_outside_fraction"),
}
ROAD_USERS = np.arange(11, 19, dtype=np.uint8)  # Cityscapes train ids, person to bicycle
_TRACKED_AGE = 2  # scans
_BOX_MARGIN_M = 0.5  # an axis-aligned box of the visible surface is smaller than the object


def trigger_metrics(
    observations: Sequence[Observation], transforms: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, dict[str, float]]:
    """The metrics of each pair at its transform, without those that no frame can show."""
    found: dict[str, dict[str, list[float]]] = {
        pair: {m: [] for m in THRESHOLDS[pair]} for pair in transforms
    }
    for observation in observations:
        there = set(pairs_of(observation.sensors)) & transforms.keys()
        if observation.is_unlabelled:
            there -= {"camera_lidar", "camera_radar"}
        labels = labels_of(observation) if "camera" in observation.sensors else np.zeros((0, 0), np.uint8)
        if "camera_lidar" in there:
            outside = _lidar_outside(observation, labels, transforms["camera_lidar"])
            _append(found["camera_lidar"], lidar_outside_fraction=outside)
        if "camera_radar" in there:
            outside = _radar_outside_image(observation, labels, transforms["camera_radar"])
            _append(found["camera_radar"], radar_outside_image=outside)
        if "lidar_radar" in there:
            _append(
                found["lidar_radar"],
                radar_outside_lidar=_radar_outside_lidar(observation, transforms["lidar_radar"]),
                drivable_outside_fraction=_drivable_outside(observation, transforms["lidar_radar"]),
            )
    return {p: {name: float(np.mean(v)) for name, v in metrics.items() if v} for p, metrics in found.items()}


def exceeded(metrics: Mapping[str, float], config: TriggerConfig) -> list[str]:
    """Names of the metrics above their thresholds."""
    return [name for name, value in metrics.items() if value > getattr(config, name)]


def _append(found: dict[str, list[float]], **values: float | None) -> None:
    for name, value in values.items():
        if value is not None:
            found[name].append(value)


def _lidar_outside(observation: Observation, labels: np.ndarray, T_camera_lidar: np.ndarray) -> float | None:
    """Cluster points that fall on no reflecting class, as a share of the cloud in view."""
    camera = camera_at_label_size(observation, labels)
    cloud = _classes(camera, labels, transform_points(T_camera_lidar, observation.lidar_map_xyz_m))
    if not len(cloud):
        return None
    clusters = _classes(camera, labels, transform_points(T_camera_lidar, cluster_points(observation)))
    return float(np.sum(~np.isin(clusters, REFLECTING)) / len(cloud))


def _radar_outside_image(
    observation: Observation, labels: np.ndarray, T_camera_radar: np.ndarray
) -> float | None:
    """Dynamic detections in view that fall on no road user."""
    camera, dynamic = camera_at_label_size(observation, labels), _dynamic(observation)
    if not len(dynamic):
        return None
    return float(
        np.sum(~np.isin(_classes(camera, labels, transform_points(T_camera_radar, dynamic)), ROAD_USERS))
    )


def _classes(camera: Camera, labels: np.ndarray, points_camera: np.ndarray) -> np.ndarray:
    """Classes under the points in the image."""
    uv, valid = camera.project(points_camera)
    pixel = np.round(uv[valid & camera.contains(uv)]).astype(int)
    return np.asarray(labels[pixel[:, 1], pixel[:, 0]])


def _dynamic(observation: Observation) -> Float[np.ndarray, "K 3"]:
    """Moving clusters seen before, within the paper's range, radar frame."""
    near = np.linalg.norm(observation.radar_track_xyz_m, axis=1) < FAR_M
    seen_before = observation.radar_track_age >= _TRACKED_AGE
    return observation.radar_track_xyz_m[near & seen_before].astype(np.float64)


def _radar_outside_lidar(observation: Observation, T_lidar_radar: np.ndarray) -> float | None:
    """Dynamic detections outside every lidar cluster's box (horizontally only where the radar has no elevation)."""
    dynamic = _dynamic(observation)
    if not len(dynamic) or not len(observation.lidar_cluster_min_m):
        return None
    axes = 3 if observation.radar_has_elevation else 2
    points = transform_points(T_lidar_radar, dynamic)[:, None, :axes]
    low = observation.lidar_cluster_min_m[None, :, :axes] - _BOX_MARGIN_M
    high = observation.lidar_cluster_max_m[None, :, :axes] + _BOX_MARGIN_M
    return float(np.sum(~np.all((points >= low) & (points <= high), axis=2).any(axis=1)))


def _drivable_outside(observation: Observation, T_lidar_radar: np.ndarray) -> float | None:
    """Share of the lidar's drivable cells in the radar's sector outside the radar's drivable area."""
    azimuth = observation.radar_drivable_azimuth_rad
    if len(azimuth) < 2 or not len(observation.lidar_drivable_xyz_m):
        return None
    cells = transform_points(inverse(T_lidar_radar), observation.lidar_drivable_xyz_m.astype(np.float64))
    bearing = np.arctan2(cells[:, 1], cells[:, 0])
    reach = observation.radar_drivable_range_m.max()
    seen = (
        (bearing > azimuth.min())
        & (bearing < azimuth.max())
        & (np.hypot(cells[:, 0], cells[:, 1]) < min(reach, FAR_M))
    )
    if not seen.any():
        return None
    soft = drivable_map(azimuth, observation.radar_drivable_range_m)
    row = np.clip((cells[seen, 0] / CELL_M).astype(int), 0, soft.shape[0] - 1)
    column = np.clip(((cells[seen, 1] + FAR_M) / CELL_M).astype(int), 0, soft.shape[1] - 1)
    return float(np.mean(soft[row, column] < 0.5))
