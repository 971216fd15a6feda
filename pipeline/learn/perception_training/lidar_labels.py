"""Labels of lidar points from the camera's semantics; they are weak, due to errors of calibration and semantics.

A point takes the class of its pixel if all pixels around agree: near boundaries, a small error of the
calibration or the distance between the sensors would give it the neighbour's class. Points hidden from the
camera have no label.

Source: paper, section 4.2 (RangeNet++); labels of SemanticKITTI, so that larger networks can replace this
one.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import transform_points
from schemas.observations import Observation

__all__ = [
    "GROUND",
    "KINDS",
    "KIND_OF_LABEL",
    "LABELS",
    "UNLABELLED",
    "hidden_points",
    "project_labels",
    "standing_points",
]

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
# What stands is taller than this within a cell of azimuth and range, and covers so much around each of its points: half
# of what rows and columns of sparse sweeps are apart. What lies less than a cell behind may be the same thing.
_STANDS_M, _CELL_RAD, _CELL_M = 0.3, np.radians(1.0), 1.0
_COVERS_RAD = np.radians([0.25, 0.7])  # azimuth, elevation
_TABLE = np.zeros(256, np.uint8)
_TABLE[: len(_OF_CITYSCAPES)] = [LABELS.index(name) for name in _OF_CITYSCAPES]


def project_labels(
    observation: Observation,
    T_camera_lidar: Float[np.ndarray, "4 4"],
    xyz_m: Float32[np.ndarray, "N 3"],
) -> UInt8[np.ndarray, " N"]:
    """Label of each point of the sweep (finite points, lidar frame); UNLABELLED if the camera shows none."""
    image = labels_of(observation)
    camera = camera_of(observation).scaled(observation.label_scale)
    half = max(1, round(np.radians(_MARGIN_DEG) * camera.focal_px[0]))
    window = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    agreed = cv2.erode(image, window) == cv2.dilate(image, window)
    points_camera = transform_points(T_camera_lidar, xyz_m.astype(np.float64))
    uv, valid = camera.project(points_camera)
    valid &= ~hidden_points(points_camera, standing_points(xyz_m))
    pixel = np.rint(np.where(valid[:, None], uv, -1)).astype(np.int64)
    height, width = image.shape
    seen = valid & (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
    u, v = np.where(seen, pixel[:, 0], 0), np.where(seen, pixel[:, 1], 0)
    return np.where(seen & agreed[v, u], _TABLE[image[v, u]], UNLABELLED).astype(np.uint8)


def standing_points(xyz_m: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Points of upright objects: other points of the same direction and range are higher or lower (lidar frame)."""
    azimuth = np.floor(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / _CELL_RAD).astype(np.int64)
    ring = np.floor(np.hypot(xyz_m[:, 0], xyz_m[:, 1]) / _CELL_M).astype(np.int64)
    _, cell = np.unique(azimuth * 100_000 + ring, return_inverse=True)
    cell = cell.ravel()
    highest, lowest = np.full(cell.max(initial=0) + 1, -np.inf), np.full(cell.max(initial=0) + 1, np.inf)
    np.maximum.at(highest, cell, xyz_m[:, 2])
    np.minimum.at(lowest, cell, xyz_m[:, 2])
    return np.asarray((highest - lowest)[cell] > _STANDS_M)


def hidden_points(
    points_camera: Float[np.ndarray, "N 3"], standing: Bool[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Points hidden from the camera by standing objects (optical frame)."""
    range_m = np.linalg.norm(points_camera, axis=1)
    ahead = points_camera[:, 2] > 0
    angles = np.stack(
        [np.arctan2(points_camera[:, 0], points_camera[:, 2]), -points_camera[:, 1] / range_m], 1
    )
    row = np.floor((angles + np.pi) / _COVERS_RAD).astype(np.int64)
    nearest = np.full(
        (int(2 * np.pi / _COVERS_RAD[0]) + 3, int(2 * np.pi / _COVERS_RAD[1]) + 3), np.inf, np.float32
    )
    who = standing & ahead
    np.minimum.at(nearest, (row[who, 0], row[who, 1]), range_m[who])
    around = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    return np.asarray(ahead & (range_m > around[row[:, 0], row[:, 1]] + _CELL_M))
