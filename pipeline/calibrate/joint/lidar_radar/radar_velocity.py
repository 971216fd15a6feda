"""Frames whose radar velocity is wrong: it decides which detections are static, and where points are a moment later.

A radar's own velocity is that on which most detections agree. Beside a convoy that is the convoy's: on a
simulated highway 18 of 67 frames were 3 to 9 m/s off, their moving vehicles taken for static ones, and moved
x by 0.2 to 1.5 m at a sigma of 0.09. The car's odometry contradicts such frames, and so does a direction of
travel that never changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from schemas.observations import Observation

__all__ = ["contradicts_odometry", "turns_unmeasured"]

_FEWEST_FRAMES = 5
_MOVING_MPS = 3.0
# Of a radar 3 m ahead of the axle: 6 deg/s, 0.1 deg in 20 ms; Doppler's own noise is 0.05 m/s.
_SIDEWAYS_MPS = 0.3
# What radar and odometry may differ by: on 15 of 16 simulated days no frame was beyond 0.4 m/s, except for real
# outliers.
_DIFFERENT_MPS = 0.5
_DIFFERENT_SHARE = 0.03  # of the speed
_MOST = 0.5  # of the frames: where more contradict it, the odometry is wrong
_LEVER_M = (-1.0, 6.0)  # of a radar ahead of the rear axle
_PASSES = 8  # of fitting lever arm and mounting in turn


def turns_unmeasured(observations: Sequence[Observation]) -> Bool[np.ndarray, " F"]:
    """Frames taken in a turn without a measured yaw rate.

    A radar ahead of the rear axle moves sideways in a turn, by yaw rate times lever arm. Without the yaw rate
    neither the lidar's sweep nor the gap between the stamps is corrected: on a real day one such turn of
    eleven frames moved yaw by 0.25 deg, x by 15 cm and dt by 10 ms against all other streets.
    """
    unmeasured = np.array([o.ego_yaw_rate_radps is None for o in observations], bool)
    return unmeasured & (np.abs(_travel(observations)[:, 1]) > _SIDEWAYS_MPS)


def contradicts_odometry(observations: Sequence[Observation]) -> Bool[np.ndarray, " F"]:
    """Frames whose radar velocity is impossible on this car, by its speed or its yaw rate.

    Sideways the radar moves by yaw rate times a lever arm, the same all day; an odometer may count a constant
    share too much. What the car does not log cannot be contradicted, and an odometry that most frames
    contradict is itself wrong.
    """
    travel = _travel(observations)
    radar_mps = np.hypot(travel[:, 0], travel[:, 1])
    odometer_mps = np.abs([np.nan if o.ego_speed_mps is None else o.ego_speed_mps for o in observations])
    both = (radar_mps > _MOVING_MPS) & (odometer_mps > _MOVING_MPS)
    wrong = np.array([o.ego_yaw_rate_radps is not None for o in observations], bool)
    wrong &= np.abs(travel[:, 1]) > _DIFFERENT_MPS
    if both.any():
        scale = float(np.median(radar_mps[both] / odometer_mps[both]))
        apart_mps = np.abs(radar_mps - scale * odometer_mps)
        wrong |= apart_mps > _DIFFERENT_MPS + _DIFFERENT_SHARE * odometer_mps
    return wrong if wrong.sum() <= _MOST * len(wrong) else np.zeros_like(wrong)


def _travel(observations: Sequence[Observation]) -> Float[np.ndarray, "F 2"]:
    """Velocities along the day's direction of travel, and across it beyond the effect of the measured turn.

    NaN for a frame without velocity, and for all if too few frames move to determine the direction.
    """
    velocity = np.array(
        [
            np.full(2, np.nan) if o.radar_velocity_mps is None else o.radar_velocity_mps[:2]
            for o in observations
        ]
    ).reshape(-1, 2)
    turn = np.array([o.ego_yaw_rate_radps or 0.0 for o in observations])
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > _MOVING_MPS
    if moving.sum() < _FEWEST_FRAMES:
        return np.full_like(velocity, np.nan)
    # How the radar is mounted; the mean of all ways first, for a radar that looks back has angles about +-180 deg.
    ahead = _turned_by(velocity, -np.arctan2(*velocity[moving].sum(0)[::-1]))
    angle, sharpness = np.arctan2(ahead[moving, 1], ahead[moving, 0]), turn[moving] / speed[moving]
    mounted, lever_m = float(np.median(angle)), 0.0
    for _ in range(_PASSES):
        lever_m = _lever_m(angle - mounted, sharpness)
        mounted = float(np.median(angle - lever_m * sharpness))
    ahead = _turned_by(ahead, -mounted)
    return ahead - np.stack([np.zeros_like(turn), lever_m * turn], 1)


def _turned_by(velocity: np.ndarray, angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return velocity @ np.array([[c, s], [-s, c]])


def _lever_m(angle_rad: np.ndarray, sharpness_radpm: np.ndarray) -> float:
    """Lever arm by least absolute deviations: the median of the frames' own, weighted by how sharply they turn."""
    weight = np.abs(sharpness_radpm)
    use = weight > 0
    if not use.any():
        return 0.0
    own = angle_rad[use] / sharpness_radpm[use]
    order = np.argsort(own)
    share = np.cumsum(weight[use][order])
    return float(np.clip(own[order][np.searchsorted(share, 0.5 * share[-1])], *_LEVER_M))
