"""Errors that radars make and that can be put into observations exactly: constant elevation, bounce off the road."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.rig.se3 import from_spherical, inverse, to_spherical, transform_points
from schemas.observations import Observation

_LEAST_HEIGHT_M = 0.3  # lower, a detection is as good as its own mirror image
_NEAR_M = 5.0


def elevated(rows: Sequence[Observation], error_rad: float) -> list[Observation]:
    """All detections higher by so much; range rates stay, so their residuals follow from the new directions."""
    return [_moved(o, _higher(o.radar_xyz_m, error_rad)) for o in rows]


def bounced(
    rows: Sequence[Observation], T_lidar_radar: np.ndarray, share: float, rng: np.random.Generator
) -> list[Observation]:
    """So many of what stands above the road seen in it: the elevation of the mirror image, a path that is longer.

    Every second one comes from there and every second one goes there, so the Doppler is of one way or the other.
    """
    return [
        o if o.ground_plane is None else _moved(o, *_mirrored(o, T_lidar_radar, share, rng)) for o in rows
    ]


def _higher(xyz_m: np.ndarray, error_rad: float) -> np.ndarray:
    return from_spherical(to_spherical(xyz_m.astype(np.float64)) + [0.0, error_rad, 0.0])


def _mirrored(
    o: Observation, T_lidar_radar: np.ndarray, share: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions, and which detections keep the residual that they had."""
    assert o.ground_plane is not None
    up, offset = o.ground_plane[:3], o.ground_plane[3]
    xyz = o.radar_xyz_m.astype(np.float64)
    in_lidar = transform_points(T_lidar_radar, xyz)
    height = in_lidar @ up + offset
    image = transform_points(inverse(T_lidar_radar), in_lidar - 2 * height[:, None] * up)
    seen = to_spherical(image)
    longer = height * (T_lidar_radar[:3, 3] @ up + offset) / np.maximum(seen[:, 2], _NEAR_M)
    seen[:, 2] = np.linalg.norm(xyz, axis=1) + longer
    chosen = (height > _LEAST_HEIGHT_M) & (rng.random(len(xyz)) < share)
    moved = np.where(chosen[:, None], from_spherical(seen), xyz)
    return moved, rng.random(len(xyz)) < 0.5


def _moved(o: Observation, xyz_m: np.ndarray, keeps: np.ndarray | None = None) -> Observation:
    """With detections elsewhere: a residual is the range rate plus the own velocity along the direction."""
    if o.radar_velocity_mps is None:
        return replace(o, radar_xyz_m=xyz_m.astype(np.float32))
    before, after = (
        x / np.linalg.norm(x, axis=1, keepdims=True) for x in (o.radar_xyz_m.astype(np.float64), xyz_m)
    )
    change = (after - before) @ o.radar_velocity_mps
    residual = o.radar_residual_mps + (change if keeps is None else np.where(keeps, 0.0, change))
    return replace(o, radar_xyz_m=xyz_m.astype(np.float32), radar_residual_mps=residual.astype(np.float32))
