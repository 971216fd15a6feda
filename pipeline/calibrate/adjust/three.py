"""A rig of one camera, one lidar and one radar: its prior of two transforms as poses, its pairs as edges."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pipeline.rig.changes import change_jacobian
from pipeline.rig.estimates import Prior
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, RigGraph, Sensor
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["CAMERA", "EDGES", "LIDAR", "RADAR", "poses_of", "three_sensors"]

CAMERA, LIDAR, RADAR = Sensor("camera", "camera"), Sensor("lidar", "lidar"), Sensor("radar", "radar")
EDGES = {e.kind: e for e in (Edge(CAMERA, LIDAR), Edge(CAMERA, RADAR), Edge(LIDAR, RADAR))}


def three_sensors(pairs: Collection[str]) -> RigGraph:
    """The graph of these pairs, referred to the lidar."""
    return RigGraph((CAMERA, LIDAR, RADAR), tuple(e for p, e in EDGES.items() if p in pairs), LIDAR)


def poses_of(prior: Prior, dt_s: dict[str, float]) -> Extrinsics:
    """Poses relative to the lidar; rotation and position of each transform are independent, in parent axes.

    `dt_s` are the expected clock offsets of camera and radar to the lidar.
    """
    T_lidar_camera = inverse(prior.T_camera_lidar)
    covariance = np.zeros((12, 12))
    for k, (pair, turned) in enumerate(
        (("camera_lidar", adjoint(T_lidar_camera)), ("lidar_radar", np.eye(6)))
    ):
        to_left = turned @ np.linalg.inv(change_jacobian(prior.of(pair)))
        at = slice(6 * k, 6 * k + 6)
        covariance[at, at] = to_left @ prior.covariance(pair) @ to_left.T
    T = {"lidar": np.eye(4), "camera": T_lidar_camera, "radar": prior.T_lidar_radar}
    return Extrinsics(LIDAR, T, ("camera", "radar"), covariance, covariance, dt_s)
