"""The paper's camera-lidar loss: lidar clusters lie on reflecting objects, not in the sky, not out of view.

Per frame: mean over the points of object clusters of `d^2 / (d^2 + s^2) + [sky]`, d = distance in the image
to the nearest pixel of a reflecting class, s = 1.5 deg; a point out of view costs 1, like one in the sky. The
paper gives neither weights nor units; means make frames and pairs comparable for any number of points.

Source: section 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.objective.paper.classes import (
    REFLECTING,
    SKY,
    FoldedFrames,
    camera_at_label_size,
    distance_cost,
    fold_frames,
    frame_costs,
    in_range,
    labels_of,
    safely_in_view,
    thin,
)
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import transform_points
from schemas.observations import Observation

__all__ = ["CameraLidarLoss", "camera_lidar_loss", "cluster_points", "object_cost_map"]

SCALE_RAD = np.radians(1.5)
PENALTY = 1.0
_POINTS = 1500  # per frame: thinning to a fifth moved the optimum by 0.002 deg (performance evidence, A.3)


@dataclass(frozen=True, eq=False)
class CameraLidarLoss:
    """Points and maps of the selected frames."""

    frames: FoldedFrames

    @property
    def informative(self) -> Bool[np.ndarray, " F"]:
        """False for frames without a single cluster point in view: they cost 0 at every pose."""
        return self.frames.counts > 0

    def frame_losses(self, T_camera_lidar: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
        """Loss of each frame at each pose."""
        return frame_costs(self.frames, T_camera_lidar) / np.maximum(self.frames.counts, 1)


def camera_lidar_loss(
    observations: Sequence[Observation], T_prior: Float[np.ndarray, "4 4"], margin_rad: float
) -> CameraLidarLoss:
    """Prepare the loss of these frames, of points within `margin_rad` of the view at `T_prior`."""
    points, costs, cameras = [], [], []
    for observation in observations:
        labels = labels_of(observation)
        camera = camera_at_label_size(observation, labels)
        cloud = cluster_points(observation)
        seen = safely_in_view(camera, transform_points(T_prior, cloud), margin_rad)
        points.append(thin(cloud[seen].astype(np.float64), _POINTS))
        costs.append(object_cost_map(labels, camera))
        cameras.append(camera)
    return CameraLidarLoss(fold_frames(points, costs, cameras, PENALTY))


def cluster_points(observation: Observation) -> Float[np.ndarray, "N 3"]:
    """Points of object clusters within the range limits, lidar frame."""
    return in_range(observation.lidar_map_xyz_m[observation.lidar_map_cluster >= 0])


def object_cost_map(labels: UInt8[np.ndarray, "H W"], camera: Camera) -> Float[np.ndarray, "H W"]:
    """Cost of a lidar cluster point at each pixel, 0..2."""
    others = np.where(np.isin(labels, REFLECTING), 0, 1).astype(np.uint8)
    if others.all():  # nothing reflects: the distance transform would measure from the border
        return np.where(labels == SKY, 1.0 + PENALTY, 1.0)
    distance = cv2.distanceTransform(others, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
    return distance_cost(distance, SCALE_RAD * camera.focal_px[0]) + PENALTY * (labels == SKY)
