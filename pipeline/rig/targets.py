"""The paper's errors: azimuth, elevation and range of corner reflectors, from one sensor to another.

Camera pairs are compared as directions in the camera, lidar-radar in lidar coordinates. The loop transforms a
lidar point to the radar, to the camera and back to the lidar (section 2.2). A known truth replaces picked
positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Edge, words_of
from pipeline.rig.se3 import (
    camera_direction_angles,
    exp_se3,
    from_spherical,
    inverse,
    to_spherical,
    transform_points,
    wrap_angle,
)
from schemas.calibrations import CalibrationRecord

__all__ = [
    "DEFAULT_TARGETS", "ComparedRun", "Comparison", "PairDifference", "PickUncertainty", "Picks",
    "error_sigma_at_picks", "errors_at_targets", "errors_of_picks", "loop_error_sigma", "loop_errors",
    "target_jacobian", "target_sigmas",
]  # fmt: skip

# Three reflectors in the shared field of view of sensors that look ahead: azimuth, elevation [rad], range
# [m]. Records have other targets, visible to both of their sensors (`calibrate/verify/target_accuracy.py`).
DEFAULT_TARGETS = from_spherical(
    np.array([[np.radians(-10), 0, 15.0], [np.radians(8), 0, 25.0], [0.0, 0, 40.0]])
)
_STEP = 1e-5  # of central differences [rad and m]


@dataclass(frozen=True, eq=False)
class PickUncertainty:
    """Standard deviation of picked positions, per coordinate."""

    pixels: np.ndarray  # N 2
    lidar_m: np.ndarray  # N 3
    radar_m: np.ndarray  # N 3


@dataclass(frozen=True, eq=False)
class Picks:
    """Positions of the same reflectors as picked in each sensor's data."""

    pixels: np.ndarray  # N 2, full image
    lidar_m: np.ndarray  # N 3
    radar_m: np.ndarray  # N 3
    camera: Camera
    spread: PickUncertainty | None = None  # of one frame's pick
    sigma: PickUncertainty | None = None  # of the positions: standard errors


def errors_at_targets(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    T_true: Float[np.ndarray, "4 4"],
    targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS,
) -> Float[np.ndarray, " 3"]:
    """Mean absolute azimuth and elevation error [rad] and range error [m] at targets in the child's frame."""
    return _mean_error(pair, transform_points(T, targets), transform_points(T_true, targets))


def loop_errors(
    transforms: Mapping[str, Float[np.ndarray, "4 4"]], targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS
) -> Float[np.ndarray, " 3"]:
    """Mean absolute errors of lidar points after the loop through camera and radar; no truth is needed."""
    loop = transforms["lidar_radar"] @ inverse(transforms["camera_radar"]) @ transforms["camera_lidar"]
    return _mean_error("lidar_radar", transform_points(loop, targets), targets)


def errors_of_picks(pair: str, T: Float[np.ndarray, "4 4"], picks: Picks) -> Float[np.ndarray, " 3"]:
    """Mean absolute errors at picked reflectors; range is NaN for camera pairs, because a pixel has none."""
    if pair == "lidar_radar":
        return _mean_error(pair, transform_points(T, picks.radar_m), picks.lidar_m)
    points = transform_points(T, picks.lidar_m if pair == "camera_lidar" else picks.radar_m)
    error = _mean_error(pair, points, picks.camera.unproject(picks.pixels))
    return np.array([error[0], error[1], np.nan])


def error_sigma_at_picks(
    pair: str, T: Float[np.ndarray, "4 4"], picks: Picks, uncertainty: PickUncertainty
) -> Float[np.ndarray, " 3"]:
    """Sigma of the errors at reflectors due to the picks alone: azimuth, elevation [rad] and range [m].

    Root mean square over the reflectors, first order; range is NaN for camera pairs. T rotates the child's
    axes into the parent's; any estimate is accurate enough for that.
    """
    radar = pair == "lidar_radar"
    angles = to_spherical if radar else camera_direction_angles
    child = (
        (picks.lidar_m, uncertainty.lidar_m)
        if pair == "camera_lidar"
        else (picks.radar_m, uncertainty.radar_m)
    )
    square = _propagated(lambda p: angles(transform_points(T, p)), *child)
    if radar:
        square = square + _propagated(to_spherical, picks.lidar_m, uncertainty.lidar_m)
        return np.sqrt(square.mean(axis=0))
    square = square + _propagated(
        lambda p: camera_direction_angles(picks.camera.unproject(p)), picks.pixels, uncertainty.pixels
    )
    return np.array([*np.sqrt(square.mean(axis=0)), np.nan])


def loop_error_sigma(
    transforms: Mapping[str, Float[np.ndarray, "4 4"]], picks: Picks, uncertainty: PickUncertainty
) -> Float[np.ndarray, " 3"]:
    """Sigma of loop errors due to the picks: nearly 0, as the loop compares a lidar point with itself."""
    loop = transforms["lidar_radar"] @ inverse(transforms["camera_radar"]) @ transforms["camera_lidar"]
    return np.sqrt(
        _propagated(
            lambda p: to_spherical(transform_points(loop, p)) - to_spherical(p),
            picks.lidar_m,
            uncertainty.lidar_m,
        ).mean(axis=0)
    )


def _propagated(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Variance of function(at) per row, by central differences of one standard deviation."""
    total = np.zeros(1)
    for axis in range(at.shape[1]):
        step = np.zeros_like(at)
        step[:, axis] = sd[:, axis]
        total = total + ((function(at + step) - function(at - step)) / 2) ** 2
    return total


def _mean_error(pair: str, points: np.ndarray, true: np.ndarray) -> np.ndarray:
    if not pair.startswith("camera"):
        difference = to_spherical(points) - to_spherical(true)
        angles, distance = difference[:, :2], difference[:, 2]
    else:
        angles = camera_direction_angles(points) - camera_direction_angles(true)
        distance = np.linalg.norm(points, axis=1) - np.linalg.norm(true, axis=1)
    return np.array([*np.abs(wrap_angle(angles)).mean(axis=0), np.abs(distance).mean()])


def target_jacobian(
    pair: str, T: Float[np.ndarray, "4 4"], targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS
) -> Float[np.ndarray, "2 N 6"]:
    """d(azimuth, elevation of each target) / d(left perturbation of T) [rad per rad and m]."""
    angles = camera_direction_angles if pair.startswith("camera") else to_spherical
    points = transform_points(T, targets)
    columns = []
    for steps in _nudges():
        ahead, behind = (angles(transform_points(step, points)) for step in steps)
        columns.append(wrap_angle(ahead[:, :2] - behind[:, :2]) / (2 * _STEP))
    return np.stack(columns, -1).transpose(1, 0, 2)


@cache
def _nudges() -> tuple[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]], ...]:
    """Small twists forward and back along each axis, cached: computing them dominated the Jacobian."""
    return tuple((exp_se3(_STEP * axis), exp_se3(-_STEP * axis)) for axis in np.eye(6))


def target_sigmas(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS,
) -> Float[np.ndarray, " 2"]:
    """One sigma of azimuth and elevation [rad] at the targets, root mean square over them."""
    J = target_jacobian(pair, T, targets)
    return np.sqrt(np.einsum("dni,ij,dnj->dn", J, covariance, J).mean(axis=1))


@dataclass(frozen=True, eq=False)
class PairDifference:
    """Change from A's estimate of a pair to B's.

    Args:
        change: rotation vector [rad], shift of the child's origin [m], along the axes of the parent.
        sigma: sigmas of the change; None if neither side has any.
        determined: per DoF, determined by the data of both sides, or given.
        targets_rad: change of azimuth and elevation of targets 15 to 40 m away, root mean square.
    """

    edge: Edge
    statuses: tuple[str, str]
    change: Float[np.ndarray, " 6"]
    sigma: Float[np.ndarray, " 6"] | None
    determined: Bool[np.ndarray, " 6"]
    targets_rad: Float[np.ndarray, " 2"]

    @property
    def pair(self) -> str:
        """Text for the edge."""
        return words_of(self.edge)

    @property
    def z(self) -> Float[np.ndarray, " 6"] | None:
        """The change in units of sigma; None without sigmas."""
        return None if self.sigma is None else self.change / self.sigma


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of one run (all pairs with one work key) against the truth."""

    method: str
    environment: str
    errors: dict[str, np.ndarray]  # pair or "loop" -> azimuth, elevation [rad], range [m]
    prior_errors: dict[str, np.ndarray]
    statuses: dict[str, str]
    normalised: np.ndarray  # error / sigma of every observable DoF of all pairs
    # Loop of independently estimated pairs: angle [rad] and shift [m]; the shift is None if not determined.
    independent_loop: tuple[float, float | None] | None = None
    truth_spread: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # like errors: standard deviation of the picks in one frame
    truth_sigma: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # like errors: 1 sigma of the mean picked positions


class ComparedRun(NamedTuple):
    """One run (records by pair), the truth or picks it was compared with, and the result."""

    run: dict[str, CalibrationRecord]
    truth: dict[str, np.ndarray] | None
    picks: Picks | None
    comparison: Comparison
