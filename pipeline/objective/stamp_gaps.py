"""Differences between the stamps of one frame, and the part that is constant over the day.

The sensors of a frame measure at different times: their stamps give the differences, up to a time offset that
all stamps of a sensor share. Terms bridge the gaps of each frame by the car's motion, and solve for the
offset. If a sensor is triggered by the lidar, its gaps are constant: either it measured with the lidar and
its clock is off, or both clocks are right and it measured later. The first is expected, with the prior's
sigma for the time offset, and there the estimate starts. Gaps of sensors that run freely have a median near
0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64

from schemas.observations import Observation

__all__ = ["constant_gap_s", "expected_dt_s", "gaps_s", "motion_gates_ns", "scan_to_image_s", "turned"]

# What is taken for a car that nobody measured, and for others that drive past one that stands.
_UNKNOWN_MPS, _UNKNOWN_RADPS, _OTHERS_MPS = 40.0, float(np.radians(30.0)), 10.0


def gaps_s(observations: Sequence[Observation], sensor: str) -> Float[np.ndarray, " F"]:
    """Stamp of the camera or radar minus the sweep's of each frame [s].

    Frames without the sensor get the constant gap, so that they have no effect.
    """
    stamps = [getattr(o, f"{sensor}_stamp_ns") - o.stamp_ns for o in observations]
    gaps, there = np.array(stamps, np.float64) * 1e-9, [sensor in o.sensors for o in observations]
    return gaps if all(there) else np.where(there, gaps, constant_gap_s(gaps[there]))


def constant_gap_s(gaps_s: Float[np.ndarray, " F"]) -> float:
    """The part of a sensor's gaps that all frames share [s]: their median; 0 without frames."""
    return float(np.median(gaps_s)) if len(gaps_s) else 0.0


def expected_dt_s(gaps_s: Float[np.ndarray, " F"], stamp_sigma_s: float | None) -> float:
    """Stamps of a clock that is kept are right; of an unknown one (None), a gap of all frames is its error [s]."""
    return constant_gap_s(gaps_s) if stamp_sigma_s is None else 0.0


def scan_to_image_s(observations: Sequence[Observation]) -> Float[np.ndarray, " F"]:
    """Time from each image to its scan [s], with constant gaps removed as errors of the clocks."""
    radar, camera = gaps_s(observations, "radar"), gaps_s(observations, "camera")
    return (radar - constant_gap_s(radar)) - (camera - constant_gap_s(camera))


def motion_gates_ns(
    speed_mps: Float[np.ndarray, " L"],
    yaw_rate_radps: Float[np.ndarray, " L"],
    move_m: float,
    turn_rad: float,
) -> Int64[np.ndarray, " L"]:
    """Per sweep, the time in which the car drives `move_m` or turns `turn_rad`, whichever comes first [ns].

    Unknown speeds and yaw rates (NaN) are replaced by the maximum of a car.
    """
    speed = np.maximum(np.where(np.isnan(speed_mps), _UNKNOWN_MPS, np.abs(speed_mps)), _OTHERS_MPS)
    turn = np.where(np.isnan(yaw_rate_radps), _UNKNOWN_RADPS, np.abs(yaw_rate_radps))
    return (1e9 * np.minimum(move_m / speed, turn_rad / np.maximum(turn, 1e-6))).astype(np.int64)


def turned(points: Float[np.ndarray, "N 3"], angle_rad: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
    """Points, each turned to the left about the vertical by its own angle."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = points.T
    return np.stack([c * x - s * y, s * x + c * y, z], -1)
