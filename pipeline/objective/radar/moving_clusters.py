"""Moving radar clusters against lidar object clusters, and against the centres of camera boxes, in azimuth.

A moving cluster of detections is a road user. Nearly always, so are the lidar cluster at its position and the
box at its azimuth. Only azimuth is compared: ranges differ, because the radar sees 0.2-0.3 m into objects,
and elevations suffer from bounces off the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree

from pipeline.core.rows import columns_of
from pipeline.objective.radar.registration import robust_equations, rows_of_frames
from pipeline.objective.radar.vehicle_boxes import median_of_rows
from pipeline.objective.stamp_gaps import gaps_s, scan_to_image_s, turned
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import camera_direction_angles, inverse, transform_points, wrap_angle
from schemas.observations import Observation

__all__ = [
    "MATCH_RAD", "ROAD_USER_HEIGHT_M", "MovingClusters", "azimuth_equations_camera",
    "azimuth_equations_lidar", "camera_azimuth_residuals", "camera_radar_cost", "lidar_azimuth_residuals",
    "moving_clusters",
]  # fmt: skip

MATCH_RAD = np.radians(1.0)  # cluster to box: half a car at 40 m
_GATE_M = 2.5  # lidar cluster centre to radar cluster centre: half a car, twice
_APART_M = 1e3
_LEAST_DETECTIONS = 2
_LARGEST_M = 12.0  # lidar clusters longer than a lorry are walls
_RANGE_FACTOR = 1.8
# Usual heights; what is not among them is as high as a car.
ROAD_USER_HEIGHT_M = {
    "person": 1.7,
    "rider": 1.7,
    "bicycle": 1.6,
    "motorcycle": 1.6,
    "truck": 2.9,
    "bus": 3.0,
    "train": 3.5,
}
_CLUSTER = np.dtype(
    [("point_radar_m", "f8", 3), ("relative_mps", "f8", 3), ("frame", "i8")]
)  # of MovingClusters


@dataclass(frozen=True, eq=False)
class MovingClusters:
    """Centres of moving clusters in radar axes, with the data to move them to the lidar's and the camera's time."""

    point_radar_m: Float[np.ndarray, "B 3"]
    relative_mps: Float[np.ndarray, "B 3"]  # velocity relative to the radar along the line of sight
    stamp_gap_s: Float[np.ndarray, " B"]  # radar stamp minus lidar stamp
    after_image_s: Float[np.ndarray, " B"]  # as in `stamp_gaps.scan_to_image_s`
    yaw_rate_radps: Float[np.ndarray, " B"]  # own, positive to the left
    frame: Int64[np.ndarray, " B"]  # index into the observations given
    lidar_centres_m: list[np.ndarray]  # per observation: lidar clusters that can be road users
    box_azimuths: list[tuple[np.ndarray, np.ndarray]]  # per observation: azimuth and range by height of boxes

    @property
    def count(self) -> int:
        """Number of clusters."""
        return len(self.frame)

    @property
    def observations(self) -> int:
        """Number of observations that they were taken from."""
        return len(self.box_azimuths)

    @cached_property
    def centres(self) -> cKDTree:
        """All lidar clusters in the plane; different observations are far apart in the third coordinate."""
        frame = np.repeat(np.arange(len(self.lidar_centres_m)), [len(c) for c in self.lidar_centres_m])
        flat = np.concatenate([*self.lidar_centres_m, np.zeros((0, 3))])[:, :2]
        return cKDTree(np.column_stack([flat, _APART_M * frame]))

    def of_frames(self, frames: Int64[np.ndarray, " S"]) -> MovingClusters:
        """The part of some observations, which are renumbered in the given order."""
        return replace(
            rows_of_frames(self, frames),
            lidar_centres_m=[self.lidar_centres_m[f] for f in frames],
            box_azimuths=[self.box_azimuths[f] for f in frames],
        )

    def at_lidar_time(self, dt_s: float) -> Float[np.ndarray, "B 3"]:
        """Positions at the lidar's stamp, radar axes; stamp_lidar = stamp_radar + dt."""
        return self._earlier(self.stamp_gap_s + dt_s)

    def at_image_time(self) -> Float[np.ndarray, "B 3"]:
        """Positions at the time of the image, radar axes, for clocks off by the stamps' constant gaps."""
        return self._earlier(self.after_image_s)

    def _earlier(self, by_s: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 3"]:
        """Positions at an earlier time: moved back along the line of sight, and by the car's rotation."""
        return turned(self.point_radar_m - self.relative_mps * by_s[:, None], self.yaw_rate_radps * by_s)


def moving_clusters(observations: Sequence[Observation], with_boxes: bool = True) -> MovingClusters:
    """Moving clusters between 3 and 60 m; without boxes it is cheaper, and enough against the lidar."""
    rows = []
    for index, o in enumerate(observations):
        for label in range(int(o.radar_cluster.max(initial=-1)) + 1):
            member = o.radar_cluster == label
            if member.sum() < _LEAST_DETECTIONS:
                continue
            centre = median_of_rows(o.radar_xyz_m[member]).astype(np.float64)
            distance = float(np.linalg.norm(centre))
            if not 3.0 < distance < 60.0:
                continue
            u = centre / distance
            own = np.zeros(3) if o.radar_velocity_mps is None else o.radar_velocity_mps
            rate = float(median_of_rows(o.radar_residual_mps[member])) - u @ own
            rows.append((centre, rate * u, index))
    clusters = columns_of(rows, _CLUSTER)
    frame = clusters["frame"]
    return MovingClusters(
        **clusters,
        stamp_gap_s=gaps_s(observations, "radar")[frame],
        after_image_s=scan_to_image_s(observations)[frame],
        yaw_rate_radps=np.array([o.ego_yaw_rate_radps or 0.0 for o in observations], np.float64)[frame],
        lidar_centres_m=[_object_centres(o) for o in observations],
        box_azimuths=[_box_azimuths(o) if with_boxes else (np.zeros(0),) * 2 for o in observations],
    )


def lidar_azimuth_residuals(
    clusters: MovingClusters, T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, "B 6"], Int64[np.ndarray, " B"]]:
    """Azimuth of the nearest lidar cluster minus the radar cluster's, from the radar, and its Jacobian.

    Residuals [rad] of clusters with a partner within a gate in the plane, d/d(left twist of T_lidar_radar),
    frames.
    """
    points = clusters.at_lidar_time(dt_s)
    in_lidar = transform_points(T_lidar_radar, points)
    if not clusters.count or clusters.centres.n == 0:
        return np.zeros(0), np.zeros((0, 6)), np.zeros(0, np.int64)
    where = np.column_stack([in_lidar[:, :2], _APART_M * clusters.frame])
    _, partner = clusters.centres.query(where, distance_upper_bound=_GATE_M)
    chosen = np.flatnonzero(partner < clusters.centres.n)
    p = np.concatenate(clusters.lidar_centres_m)[partner[chosen]]
    q = transform_points(inverse(T_lidar_radar), p)
    h2 = q[:, 0] ** 2 + q[:, 1] ** 2
    residual = wrap_angle(np.arctan2(q[:, 1], q[:, 0]) - np.arctan2(points[chosen, 1], points[chosen, 0]))
    gradient = np.stack([-q[:, 1] / h2, q[:, 0] / h2, np.zeros(len(q))], -1) @ T_lidar_radar[:3, :3].T
    # The lidar point moves against the sensor: dq = R^T ([p]x dphi - drho), and g . (p x dphi) = (g x p) . dphi.
    return residual, np.concatenate([np.cross(gradient, p), -gradient], 1), clusters.frame[chosen]


def camera_azimuth_residuals(
    clusters: MovingClusters, T_camera_radar: Float[np.ndarray, "4 4"], gate_rad: float
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, "B 6"], Int64[np.ndarray, " B"]]:
    """Azimuth of each moving cluster minus that of the nearest box of fitting size, in the camera.

    Residuals [rad] of clusters with a box within `gate_rad`, d/d(left twist of T_camera_radar), frames.
    """
    in_camera = transform_points(T_camera_radar, clusters.at_image_time())
    azimuth = camera_direction_angles(in_camera)[:, 0]
    distance = np.linalg.norm(in_camera, axis=1)
    ahead = np.flatnonzero(in_camera[:, 2] > 1.0)
    box_azimuth, expected_m = (table[clusters.frame[ahead]] for table in _box_table(clusters))
    ratio = distance[ahead, None] / expected_m
    fits = (ratio < _RANGE_FACTOR) & (ratio > 1 / _RANGE_FACTOR)
    apart = azimuth[ahead, None] - box_azimuth
    gap = np.where(fits, np.abs(apart), np.inf)
    nearest = np.arange(len(ahead)), np.argmin(gap, axis=1)
    found = gap[nearest] <= gate_rad
    chosen, residual = ahead[found], apart[nearest][found]
    p = in_camera[chosen]
    h2 = p[:, 0] ** 2 + p[:, 2] ** 2
    # azimuth = atan2(-x, z); dp = dphi x p + drho
    gradient = np.stack([-p[:, 2] / h2, np.zeros(len(p)), p[:, 0] / h2], -1)
    return residual, np.concatenate([np.cross(p, gradient), gradient], 1), clusters.frame[chosen]


def _box_table(clusters: MovingClusters) -> tuple[Float[np.ndarray, "F M"], Float[np.ndarray, "F M"]]:
    """Azimuth and expected range of each frame's boxes; infinite where a frame has fewer than others."""
    most = max([len(azimuth) for azimuth, _ in clusters.box_azimuths], default=0)
    azimuth, expected_m = np.full((2, len(clusters.box_azimuths), max(most, 1)), np.inf)
    for f, boxes in enumerate(clusters.box_azimuths):
        azimuth[f, : len(boxes[0])], expected_m[f, : len(boxes[1])] = boxes
    return azimuth, expected_m


def azimuth_equations_lidar(
    clusters: MovingClusters, T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float
) -> tuple[Float[np.ndarray, "F 6 6"], Float[np.ndarray, "F 6"], float]:
    """Per frame, information and gradient of the robust azimuth cost of moving clusters against the lidar."""
    return robust_equations(*lidar_azimuth_residuals(clusters, T_lidar_radar, dt_s), clusters.observations)


def azimuth_equations_camera(
    clusters: MovingClusters, T_camera_radar: Float[np.ndarray, "4 4"], gate_rad: float
) -> tuple[Float[np.ndarray, "F 6 6"], Float[np.ndarray, "F 6"], float]:
    """The same against camera boxes; unknowns are the left twist of T_camera_radar."""
    return robust_equations(
        *camera_azimuth_residuals(clusters, T_camera_radar, gate_rad), clusters.observations
    )


def _box_azimuths(o: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth of the centre and range by height of each road-user box."""
    if not len(o.road_user_boxes_px):
        return np.zeros(0), np.zeros(0)
    camera = camera_of(o)
    x0, y0, x1, y1 = o.road_user_boxes_px.astype(np.float64).T
    xm, ym = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    rays = camera.unproject(np.stack([np.stack([xm, y], -1) for y in (ym, y0, y1)]))
    angle = camera_direction_angles(rays)
    height = np.array([ROAD_USER_HEIGHT_M.get(name, 1.5) for name in o.road_user_classes])
    ok = np.isfinite(angle).all(axis=(0, 2))
    extent = np.maximum(angle[1, :, 1] - angle[2, :, 1], 1e-3)
    return angle[0, ok, 0], (height / extent)[ok]


def _object_centres(o: Observation) -> np.ndarray:
    """Centres of lidar clusters that can be road users."""
    size = np.max(o.lidar_cluster_max_m[:, :2] - o.lidar_cluster_min_m[:, :2], axis=1, initial=0.0)
    return o.lidar_cluster_centre_m[size <= _LARGEST_M].astype(np.float64)


def camera_radar_cost(
    observations: Sequence[Observation], T_camera_radar: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " F"]:
    """Cost of each held-out frame at a pose: robust azimuth distance of moving clusters to boxes, 0..1.

    Clusters in the camera's view count, those without any box within 3 deg as 1. NaN where a frame has none
    or no boxes.
    """
    clusters = moving_clusters(observations)
    out = np.full(len(observations), np.nan)
    if not clusters.count:
        return out
    points, visible = (
        transform_points(T_camera_radar, clusters.at_image_time()),
        np.zeros(clusters.count, bool),
    )
    for f in np.unique(clusters.frame):
        own = clusters.frame == f
        uv, valid = camera_of(observations[f]).project(points[own])
        visible[own] = valid & (uv[:, 0] > 0) & (uv[:, 0] < observations[f].image_width_px - 1)
    residual, _, frame = camera_azimuth_residuals(clusters, T_camera_radar, 3 * MATCH_RAD)
    gain = np.bincount(frame, 1 / (1 + (residual / MATCH_RAD) ** 2), minlength=len(observations))
    total = np.bincount(clusters.frame[visible], minlength=len(observations))
    informative = (total > 0) & np.array([len(o.road_user_classes) > 0 for o in observations])
    out[informative] = 1 - np.minimum(gain[informative] / total[informative], 1.0)
    return out
