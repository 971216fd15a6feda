"""Sigmas of azimuth and elevation at targets 15 to 40 m away, from the covariance of a pose."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import exp_se3, transform_points
from pipeline.rig.spherical import camera_direction_angles, to_spherical, wrap_angle
from pipeline.rig.targets import DEFAULT_TARGETS

__all__ = ["target_jacobian", "target_sigmas"]

_STEP = 1e-5  # of central differences [rad and m]


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
