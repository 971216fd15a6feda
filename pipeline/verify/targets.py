"""The paper's error: azimuth, elevation (and range) of corner reflectors, carried from one sensor to another.

Camera pairs are compared as directions in the camera, lidar-radar in lidar coordinates; the loop carries a
lidar point through radar and camera back to the lidar (section 2.2). Known truth takes the place of picked
positions where it exists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import inverse, transform_points
from pipeline.geometry.spherical import camera_direction_angles, from_spherical, to_spherical, wrap_angle

__all__ = ["DEFAULT_TARGETS", "Picks", "errors_at_targets", "errors_of_picks", "loop_errors"]

# Three reflectors inside the field of view that all three sensors share: azimuth, elevation [rad], range [m].
DEFAULT_TARGETS = from_spherical(
    np.array([[np.radians(-10), 0, 15.0], [np.radians(8), 0, 25.0], [0.0, 0, 40.0]])
)


@dataclass(frozen=True, eq=False)
class Picks:
    """Positions of the same reflectors as picked in each sensor's data."""

    pixels: np.ndarray  # N 2, full image
    lidar_m: np.ndarray  # N 3
    radar_m: np.ndarray  # N 3
    camera: Camera


def errors_at_targets(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    T_true: Float[np.ndarray, "4 4"],
    targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS,
) -> Float[np.ndarray, " 3"]:
    """Mean absolute azimuth and elevation error [rad] and range error [m] at targets given in the child's frame."""
    return _mean_error(pair, transform_points(T, targets), transform_points(T_true, targets))


def loop_errors(
    transforms: Mapping[str, Float[np.ndarray, "4 4"]], targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS
) -> Float[np.ndarray, " 3"]:
    """The same for lidar points sent to camera, radar and back to the lidar; no truth is needed."""
    loop = transforms["lidar_radar"] @ inverse(transforms["camera_radar"]) @ transforms["camera_lidar"]
    return _mean_error("lidar_radar", transform_points(loop, targets), targets)


def errors_of_picks(pair: str, T: Float[np.ndarray, "4 4"], picks: Picks) -> Float[np.ndarray, " 3"]:
    """Mean absolute errors at picked reflectors; range is NaN for camera pairs, for a pixel has none."""
    if pair == "lidar_radar":
        return _mean_error(pair, transform_points(T, picks.radar_m), picks.lidar_m)
    points = transform_points(T, picks.lidar_m if pair == "camera_lidar" else picks.radar_m)
    error = _mean_error(pair, points, picks.camera.unproject(picks.pixels))
    return np.array([error[0], error[1], np.nan])


def _mean_error(pair: str, points: np.ndarray, true: np.ndarray) -> np.ndarray:
    if pair == "lidar_radar":
        difference = to_spherical(points) - to_spherical(true)
        angles, distance = difference[:, :2], difference[:, 2]
    else:
        angles = camera_direction_angles(points) - camera_direction_angles(true)
        distance = np.linalg.norm(points, axis=1) - np.linalg.norm(true, axis=1)
    return np.array([*np.abs(wrap_angle(angles)).mean(axis=0), np.abs(distance).mean()])
