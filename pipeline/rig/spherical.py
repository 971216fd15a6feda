"""Azimuth, elevation and range of points in a sensor frame (x forward, y left, z up)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["camera_direction_angles", "from_spherical", "spherical_jacobian", "to_spherical", "wrap_angle"]


def to_spherical(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """(azimuth, elevation [rad], range [m]), azimuth positive to the left, elevation upwards; 0, 0, 0 at the origin."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.sqrt(x * x + y * y + z * z)], -1)


def from_spherical(azimuth_elevation_range: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Inverse of `to_spherical`."""
    azimuth, elevation, range_m = np.moveaxis(azimuth_elevation_range, -1, 0)
    c = range_m * np.cos(elevation)
    return np.stack([c * np.cos(azimuth), c * np.sin(azimuth), range_m * np.sin(elevation)], -1)


def spherical_jacobian(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """d(azimuth, elevation, range)/d(x, y, z); undefined on the z axis."""
    x, y, z = np.moveaxis(points, -1, 0)
    h2 = x * x + y * y
    h, r2 = np.sqrt(h2), h2 + z * z
    r, o = np.sqrt(r2), np.zeros_like(x)
    return np.stack(
        [
            np.stack([-y / h2, x / h2, o], -1),
            np.stack([-x * z / (h * r2), -y * z / (h * r2), h / r2], -1),
            np.stack([x / r, y / r, z / r], -1),
        ],
        -2,
    )


def camera_direction_angles(points_camera: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
    """(azimuth, elevation) [rad] of points in the optical frame, azimuth positive to the left, elevation upwards."""
    x, y, z = np.moveaxis(points_camera, -1, 0)
    return np.stack([np.arctan2(-x, z), np.arctan2(-y, np.hypot(x, z))], -1)


def wrap_angle(angle: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The same angle in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
