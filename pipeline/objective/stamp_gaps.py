"""How far the stamps of one frame lie apart, and what part of that is the same all day.

The sensors of a frame measured at different times: their stamps tell by how much, up to a time offset that all stamps
of a sensor share. Terms bridge the gaps of each frame by the car's motion, and solve for the offset. Where a sensor is
triggered by the lidar, its gaps are constant: then it measured with the lidar and its clock is off, or both clocks are
right and it measured later. The first is expected, with the prior's sigma for the time offset, and there the estimate
starts. Gaps of sensors that run freely have a median near 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from schemas.observations import Observation

__all__ = ["camera_gaps_s", "constant_gap_s", "radar_gaps_s", "scan_to_image_s"]


def camera_gaps_s(observations: Sequence[Observation]) -> Float[np.ndarray, " F"]:
    """Image stamp minus sweep stamp of each frame [s]; the others' median of a frame without a camera."""
    gaps = np.array([(o.camera_stamp_ns - o.stamp_ns) * 1e-9 for o in observations], np.float64)
    return _filled(gaps, "camera", observations)


def radar_gaps_s(observations: Sequence[Observation]) -> Float[np.ndarray, " F"]:
    """Scan stamp minus sweep stamp of each frame [s]; the others' median of a frame without a radar."""
    gaps = np.array([(o.radar_stamp_ns - o.stamp_ns) * 1e-9 for o in observations], np.float64)
    return _filled(gaps, "radar", observations)


def constant_gap_s(gaps_s: Float[np.ndarray, " F"]) -> float:
    """The part of a sensor's gaps that all frames share [s]: their median; 0 without frames."""
    return float(np.median(gaps_s)) if len(gaps_s) else 0.0


def scan_to_image_s(observations: Sequence[Observation]) -> Float[np.ndarray, " F"]:
    """By how much each scan was taken after its image [s], if the constant gaps of both are errors of their clocks."""
    radar, camera = radar_gaps_s(observations), camera_gaps_s(observations)
    return (radar - constant_gap_s(radar)) - (camera - constant_gap_s(camera))


def _filled(gaps_s: np.ndarray, sensor: str, observations: Sequence[Observation]) -> np.ndarray:
    """The gaps, with the constant one where the sensor is absent, so that it counts for nothing."""
    there = np.array([sensor in o.sensors for o in observations], bool)
    return gaps_s if there.all() else np.where(there, gaps_s, constant_gap_s(gaps_s[there]))
