"""Checks of method `joint` on its own estimates: restarts, halves, elevations.

Each states by how much the pose would be wrong if it is right, so that only what matters holds a record.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.tilt_floors import radar_tilt_axes
from pipeline.rig.checks import FailedCheck, change_of
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
    if not estimate.diagnostics:
        return []
    failed = [_restarts(estimate), _halves(estimate), *_registration(estimate)]
    return [check for check in failed if check is not None]


def _restarts(estimate: PairEstimate) -> FailedCheck | None:
    """Ends of the search in different basins: if another one is right, the pose is off by all of their distance."""
    least = np.array([np.inf, np.inf, _RESTART_ROTATION_RAD, _RESTART_SHIFT_M, _RESTART_SHIFT_M, np.inf])
    apart = _known(estimate, "restarts")
    return _difference("restarts", apart, np.maximum(least, _SIGMAS * _sigma(estimate)), apart)


def _halves(estimate: PairEstimate) -> FailedCheck | None:
    """The pose lies between those of the halves."""
    apart = _known(estimate, "halves")
    return _difference("disjoint halves", apart, _SIGMAS * _HALVES_FACTOR * _sigma(estimate), apart / 2)


def _difference(
    who: str, apart: Float[np.ndarray, " 6"], allowed: Float[np.ndarray, " 6"], error: Float[np.ndarray, " 6"]
) -> FailedCheck | None:
    beyond = np.flatnonzero(np.abs(apart) > allowed)
    if not len(beyond):
        return None
    sizes = " and ".join(f"{_NAMES[k]} by {_size(k, float(apart[k]))}" for k in beyond.tolist())
    return FailedCheck(f"{who} disagree in {sizes}", "witnesses_disagree", error=change_of(error))


def _registration(estimate: PairEstimate) -> list[FailedCheck]:
    """What turns the radar's roll or pitch if the registration alone is right."""
    d, failed = estimate.diagnostics, []
    for axis, name in zip(radar_tilt_axes(estimate.T).T, ("roll", "pitch"), strict=True):
        offset, floor = d[f"registration_{name}_offset_rad"], d[f"registration_{name}_sigma_rad"]
        known = estimate.observable[int(np.argmax(np.abs(axis)))]
        own = float(np.sqrt(axis @ estimate.covariance[:2, :2] @ axis))
        if known and abs(offset) > _SIGMAS * np.hypot(floor, own):
            turned = f"would turn {name} by {np.degrees(offset):+.1f} deg, camera and prior would not"
            error = change_of([*(axis * offset), 0.0, 0.0, 0.0, 0.0])
            failed.append(FailedCheck(f"the registration {turned}", "witnesses_disagree", error=error))
    return failed


def _known(estimate: PairEstimate, of: str) -> Float[np.ndarray, " 6"]:
    """A change in the diagnostics, 0 where it is not there or the day did not determine it."""
    change = np.array([estimate.diagnostics.get(f"{of}_{key}", 0.0) for key in _KEYS])
    return np.where(estimate.observable, change, 0.0)


def _sigma(estimate: PairEstimate) -> Float[np.ndarray, " 6"]:
    return np.sqrt(np.diag(estimate.covariance))


def _size(k: int, value: float) -> str:
    return f"{np.degrees(value):+.2f} deg" if k < 3 else f"{value:+.3f} m"
