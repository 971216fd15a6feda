"""Checks of method `joint` on its own estimates: restarts, halves, elevations.

Each returns one value per failed check; none if all is well.
"""

from __future__ import annotations

import numpy as np

from pipeline.calibrate.joint.lidar_radar.tilt_floors import radar_tilt_axes
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import PairEstimate

__all__ = ["lidar_radar_failures"]

_SIGMAS = 3.0
# Restarts end before the last steps: only another basin counts, and only in certified axes.
_RESTART_ROTATION_RAD, _RESTART_SHIFT_M = np.radians(0.15), 0.05
_HALVES_FACTOR = 2  # two halves differ by twice the error of the whole, if their errors are independent
_NAMES = ("roll", "pitch", "yaw", "x", "y", "z")
_KEYS = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


def lidar_radar_failures(estimate: PairEstimate) -> list[FailedCheck]:
    """Restarts, halves, and the registration against the camera's boxes."""
    d = estimate.diagnostics
    if not d:
        return []
    sigma = np.sqrt(np.diag(estimate.covariance))
    failed = []
    for k, least in ((2, _RESTART_ROTATION_RAD), (3, _RESTART_SHIFT_M), (4, _RESTART_SHIFT_M)):
        key = f"restarts_{_KEYS[k]}"
        if estimate.observable[k] and abs(d[key]) > max(least, _SIGMAS * sigma[k]):
            failed.append(f"restarts disagree in {_NAMES[k]} by {_size(k, d[key])}")
    for k, name in enumerate(_NAMES):
        key = f"halves_{_KEYS[k]}"
        if estimate.observable[k] and abs(d[key]) > _SIGMAS * _HALVES_FACTOR * sigma[k]:
            failed.append(f"disjoint halves disagree in {name} by {_size(k, d[key])}")
    for axis, name in zip(radar_tilt_axes(estimate.T).T, ("roll", "pitch"), strict=True):
        offset, floor = d[f"registration_{name}_offset_rad"], d[f"registration_{name}_sigma_rad"]
        known = estimate.observable[int(np.argmax(np.abs(axis)))]
        own = float(np.sqrt(axis @ estimate.covariance[:2, :2] @ axis))
        if known and abs(offset) > _SIGMAS * np.hypot(floor, own):
            failed.append(
                f"the registration would turn {name} by {np.degrees(offset):+.1f} deg, camera and prior would not"
            )
    return [FailedCheck(sentence, "witnesses_disagree") for sentence in failed]


def _size(k: int, value: float) -> str:
    return f"{np.degrees(value):+.2f} deg" if k < 3 else f"{value:+.3f} m"
