"""Ego motion of frames: the car's pose at a sensor's stamp, and its part of a radar's Doppler."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.learn.frames.frame import Frame
from pipeline.rig.se3 import exp_se3
from schemas.captures import Scan

__all__ = ["T_root_sensor", "compensated_range_rate", "pose_at"]


def T_root_sensor(frame: Frame, T_reference_sensor: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A pose on the car, or on the reference if its pose on the car is unknown."""
    T_base = frame.mounting.T_base_reference
    return T_reference_sensor if T_base is None else T_base @ T_reference_sensor


def pose_at(frame: Frame, stamp_ns: int) -> Float[np.ndarray, "4 4"] | None:
    """T_odom_vehicle at a stamp near the moment's, by speed and yaw rate; None without odometry."""
    T, speed, turn = frame.T_odom_vehicle, frame.moment.ego_speed_mps, frame.moment.ego_yaw_rate_radps
    if T is None or speed is None or turn is None:
        return None
    dt_s = (stamp_ns - frame.moment.stamp_ns) * 1e-9
    return T @ exp_se3(np.array([0.0, 0, turn, speed, 0, 0]) * dt_s)


def compensated_range_rate(frame: Frame, sensor: str, scan: Scan) -> Float[np.ndarray, " M"]:
    """Range rates without the car's own motion: 0 for static objects; NaN if it is unknown."""
    speed, turn = frame.moment.ego_speed_mps, frame.moment.ego_yaw_rate_radps
    if speed is None or turn is None:
        return np.full(len(scan.radar_x_m), np.nan)
    T = T_root_sensor(frame, frame.T[sensor])
    velocity_radar = T[:3, :3].T @ (np.array([speed, 0, 0]) + np.cross([0, 0, turn], T[:3, 3]))
    points = scan.radar_xyz_m.astype(np.float64)
    rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
    return scan.radar_range_rate_mps + rays @ velocity_radar
