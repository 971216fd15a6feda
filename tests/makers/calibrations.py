"""Calibrations to export: one whose numbers can be worked out in the head, and random ones."""

import numpy as np

from pipeline.export.calibration import ExportedCalibration, ExportedPair
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import EDGE_OF_PAIR
from pipeline.rig.se3 import exp_se3

SIGMA = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])
CAMERA = Camera(
    "plumb_bob", np.array([[800.0, 0, 640.5], [0, 801.0, 360.25], [0, 0, 1]]),
    np.array([-0.31, 0.1, 0.001, -0.002, 0.0]), 1280, 720,
)  # fmt: skip
# A camera that looks forward, 1 m ahead of the lidar and 0.5 m above it: what lies 10 m ahead of the lidar at its own
# height is 9 m deep in the image and 0.5 m below its axis.
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.5], [1, 0, 0, -1], [0, 0, 0, 1]])
# A radar 2 m ahead of the lidar, 0.25 m to its left, 1 m below it, that looks to the left.
T_LIDAR_RADAR = np.array([[0.0, -1, 0, 2], [1, 0, 0, 0.25], [0, 0, 1, -1], [0, 0, 0, 1]])
# The lidar stands 2 m above the car's base.
T_BASE_LIDAR = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])


def calibration(T_camera_lidar=T_CAMERA_LIDAR, T_lidar_radar=T_LIDAR_RADAR, **values):
    """A calibration of three accepted pairs; `values` replace fields of ExportedCalibration."""
    T = {
        "camera_lidar": T_camera_lidar,
        "camera_radar": T_camera_lidar @ T_lidar_radar,
        "lidar_radar": T_lidar_radar,
    }
    pairs = {pair: ExportedPair(EDGE_OF_PAIR[pair], T[pair], np.diag(SIGMA**2)) for pair in T}
    fields = {
        "vehicle": "car-1", "source": "record of 2026-03-02", "method": "joint", "code_version": "0.7.0",
        "pairs": pairs, "edges": tuple(EDGE_OF_PAIR.values()), "cameras": {"camera": CAMERA},
    }  # fmt: skip
    return ExportedCalibration(**fields | values)


def random_transform(rng):
    """Any rotation, some metres away."""
    return exp_se3(np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=3) * 3]))
