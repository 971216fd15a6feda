"""Labels of lidar points, projected from the camera's semantics: weak, since calibration and semantics err.

A point takes the class of the pixel that it falls on, where all pixels around that one agree: near boundaries, a small
error of the calibration or the other sensor's viewpoint would give it its neighbour's.

Source: paper, section 4.2 (RangeNet++); labels of SemanticKITTI, so that larger networks can take this one's place.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.geometry.cameras import camera_of
from pipeline.geometry.se3 import transform_points
from pipeline.objective.paper.classes import labels_of
from schemas.observations import Observation

__all__ = ["GROUND", "KINDS", "KIND_OF_LABEL", "LABELS", "UNLABELLED", "project_labels"]

UNLABELLED = 0
# In the order of semantic-kitti.yaml's learning_map_inv.
LABELS = (
    "unlabeled", "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist",
    "road", "parking", "sidewalk", "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole",
    "traffic-sign",
)  # fmt: skip
# What perception makes of them.
KINDS = ("unknown", "road", "flat", "road_user", "other")
KIND_OF_LABEL: UInt8[np.ndarray, " 20"] = np.array([0, *[3] * 8, 1, 1, 2, 2, 4, 4, 4, 4, 2, 4, 4], np.uint8)
GROUND = (1, 2)  # kinds
# Cityscapes train ids, 0 road .. 18 bicycle, by name of the label that each becomes; no sky among points.
_OF_CITYSCAPES = (
    "road", "sidewalk", "building", "building", "fence", "pole", "traffic-sign", "traffic-sign", "vegetation",
    "terrain", "unlabeled", "person", "bicyclist", "car", "truck", "other-vehicle", "other-vehicle", "motorcycle",
    "bicycle",
)  # fmt: skip
_MARGIN_DEG = 0.25  # how far around a point's pixel the image must be of one class
_TABLE = np.zeros(256, np.uint8)
_TABLE[: len(_OF_CITYSCAPES)] = [LABELS.index(name) for name in _OF_CITYSCAPES]


def project_labels(
    observation: Observation,
    T_camera_lidar: Float[np.ndarray, "4 4"],
    xyz_m: Float32[np.ndarray, "N 3"],
) -> UInt8[np.ndarray, " N"]:
    """Label of each point of the frame's sweep (lidar frame), UNLABELLED where the camera does not say.

    Args:
        observation: holds the label image and the camera.
        T_camera_lidar: the current calibration, never a truth.
        xyz_m: finite points.
    """
    image = labels_of(observation)
    camera = camera_of(observation).scaled(observation.label_scale)
    half = max(1, round(np.radians(_MARGIN_DEG) * camera.focal_px[0]))
    window = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    agreed = cv2.erode(image, window) == cv2.dilate(image, window)
    uv, valid = camera.project(transform_points(T_camera_lidar, xyz_m.astype(np.float64)))
    pixel = np.rint(np.where(valid[:, None], uv, -1)).astype(np.int64)
    height, width = image.shape
    seen = valid & (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
    u, v = np.where(seen, pixel[:, 0], 0), np.where(seen, pixel[:, 1], 0)
    return np.where(seen & agreed[v, u], _TABLE[image[v, u]], UNLABELLED).astype(np.uint8)
