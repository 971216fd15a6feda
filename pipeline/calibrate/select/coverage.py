"""Coverage of a pair's view by cells: for choosing frames by information, and for naming gaps.

A cell is an interval of azimuth, elevation and range. The hundredth edge in a cell adds less than the first,
so a set of frames is worth the sum over cells of log(1 + points); the frame that adds most comes next
(submodular: greedy is within 1 - 1/e of the best choice, Nemhauser et al. 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.reasons import because
from pipeline.rig.se3 import transform_points
from pipeline.rig.spherical import camera_direction_angles, to_spherical
from schemas.observations import Observation

__all__ = ["choose_for_information", "contents_of", "missing_in_view"]

_AZIMUTH_RAD = np.radians([-35.0, -20.0, -7.0, 7.0, 20.0, 35.0])
_ELEVATION_RAD = np.radians([-6.0, -1.5, 1.5])
_RANGE_M = np.array([10.0, 20.0, 40.0])
_CELLS = (len(_AZIMUTH_RAD) + 1) * (len(_ELEVATION_RAD) + 1) * (len(_RANGE_M) + 1)
_SIDE_DEG, _FAR_M, _NEAR_M = 15.0, 40.0, 10.0
_SCARCE = 0.02  # of all points of a kind


@dataclass(frozen=True)
class _Kind:
    """Points of one kind that a pair is calibrated from."""

    name: str
    words: str
    camera_axes: bool = False  # seen from the camera by the prior; else from the sensor that measured them
    far: bool = True  # worth having beyond _FAR_M


_KINDS = {
    "camera_lidar": (
        _Kind("lidar_edge_xyz_m", "poles, signs or cars (depth edges)", camera_axes=True),
        _Kind("marking_xyz_m", "road markings", camera_axes=True, far=False),
    ),
    "camera_radar": (_Kind("radar_track_xyz_m", "moving road users"),),
    "lidar_radar": (
        _Kind("radar_xyz_m", "radar detections"),
        _Kind("radar_track_xyz_m", "moving road users"),
    ),
}


def contents_of(observations: Sequence[Observation], pair: str) -> Float[np.ndarray, "F C"]:
    """Points of each frame in each cell, kinds one after another."""
    return np.array([np.concatenate([_cells(o, kind) for kind in _KINDS[pair]]) for o in observations])


def choose_for_information(
    candidates: Sequence[int], contents: Float[np.ndarray, "F C"], count: int
) -> list[int]:
    """Of each of `count` equal stretches of the candidates, the frame that adds most to those chosen before."""
    if len(candidates) <= count:
        return sorted(candidates)
    total, chosen = np.zeros(contents.shape[1]), []
    for stretch in np.array_split(np.array(sorted(candidates)), count):
        gain = (np.log1p(total + contents[stretch]) - np.log1p(total)).sum(axis=1)
        chosen.append(int(stretch[np.argmax(gain)]))
        total += contents[chosen[-1]]
    return chosen


def missing_in_view(observations: Sequence[Observation], pair: str) -> list[str]:
    """Nearly empty parts of the view, in words."""
    missing = []
    for kind in _KINDS[pair]:
        views = [_seen(o, kind) for o in observations]
        azimuth, _, distance = np.concatenate(views).T if views else np.zeros((3, 0))
        if not len(azimuth):
            missing.append(because("drive where", what=kind.words))
            continue
        parts = {
            f"left of {_SIDE_DEG:.0f} deg": azimuth > np.radians(_SIDE_DEG),
            f"right of -{_SIDE_DEG:.0f} deg": azimuth < -np.radians(_SIDE_DEG),
            f"beyond {_FAR_M:.0f} m": (distance > _FAR_M) | (not kind.far),
            f"nearer than {_NEAR_M:.0f} m": distance < _NEAR_M,
        }
        empty = [where for where, there in parts.items() if there.mean() < _SCARCE]
        if empty:
            missing.append(because("drive where, some", what=kind.words, where=" and ".join(empty)))
    return missing


def _cells(observation: Observation, kind: _Kind) -> Float[np.ndarray, " C"]:
    azimuth, elevation, distance = _seen(observation, kind).T
    index = np.searchsorted(_AZIMUTH_RAD, azimuth)
    index = index * (len(_ELEVATION_RAD) + 1) + np.searchsorted(_ELEVATION_RAD, elevation)
    index = index * (len(_RANGE_M) + 1) + np.searchsorted(_RANGE_M, distance)
    return np.bincount(index, minlength=_CELLS).astype(float)


def _seen(observation: Observation, kind: _Kind) -> Float[np.ndarray, "N 3"]:
    """Azimuth, elevation [rad] and range [m]; for the camera only points ahead."""
    points = np.asarray(getattr(observation, kind.name), np.float64).reshape(-1, 3)
    o = observation
    if kind.camera_axes and "camera_lidar" in o.priors:
        points = transform_points(o.priors["camera_lidar"], points)
        points = points[points[:, 2] > 1.0]
        return np.column_stack([camera_direction_angles(points), np.linalg.norm(points, axis=1)])
    return to_spherical(points)
