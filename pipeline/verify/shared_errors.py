"""Inputs of an answer about a shipped calibration, and the largest undetected error of each input alone.

A check that uses the same labels and CameraInfo as the estimate has the same errors; the page lists these checks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["passes_of", "reads_of"]

_SIGMAS = 3.0  # beyond which the checks of labels and of CameraInfo fail
_READS: Final[Mapping[str, tuple[str, ...]]] = {
    "camera_lidar": ("camera labels", "CameraInfo", "lidar points", "stamps"),
    "camera_radar": ("detected boxes", "CameraInfo", "radar points", "stamps"),
    "lidar_radar": ("lidar points", "radar points", "Doppler", "stamps"),
    "lidar_lidar": ("lidar points", "stamps"),
    "lidar_base": ("lidar points", "car's motion"),
    "radar_base": ("radar points", "Doppler", "car's motion"),
}


def reads_of(pair: str, edges: Iterable[str], kinds: Mapping[str, str]) -> list[str]:
    """Inputs of the answer about a sensor.

    Args:
        pair: kind of the pair whose limits apply.
        edges: edges that determine its pose, as "front-top"; empty = the pair alone.
        kinds: kind of each sensor by name.
    """
    found = ["_".join(kinds.get(end, end) for end in edge.split("-")) for edge in edges] or [pair]
    return list(dict.fromkeys(source for name in found for source in _READS.get(name, ())))


def passes_of(record: CalibrationRecord | None, frame: Observation | None) -> dict[str, float]:
    """For each source, the error [rad] that rotates a camera without being detected by the log's own checks.

    Args:
        record: record of the camera and a lidar; if it is None or has no numbers, the result is empty.
        frame: any frame of the log, for the scale of its labels.
    """
    d, found = {} if record is None else record.diagnostics, {}
    for axis, mounted, label, k in (("azimuth", "yaw", "u", 0), ("elevation", "pitch", "v", 1)):
        if f"mounting_{mounted}_sigma_rad" in d:
            found[f"CameraInfo {axis}"] = _SIGMAS * d[f"mounting_{mounted}_sigma_rad"]
        if f"label_shift_{label}_sigma_px" in d and frame is not None:
            focal_px = float(frame.camera_K[k, k]) * frame.label_scale
            found[f"labels {axis}"] = _SIGMAS * d[f"label_shift_{label}_sigma_px"] / focal_px
    return {name: value for name, value in found.items() if np.isfinite(value)}
