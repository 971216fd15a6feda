"""Change between two estimates of one transform, in measurable quantities.

A change is (rotation vector, shift of the child's origin), both along the axes of the parent frame. Unlike
the twist of the left perturbation, its translation is the plain difference of the columns tx_m, ty_m, tz_m:
a sensor that only rotated in its bracket has no shift, for any lever arm.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import exp_so3, from_rotation_translation, hat, log_so3

__all__ = ["change_between", "change_covariance", "change_jacobian", "changed"]


def change_between(
    T_before: Float[np.ndarray, "*#batch 4 4"], T_after: Float[np.ndarray, "*#batch 4 4"]
) -> Float[np.ndarray, "*batch 6"]:
    """Change (rx ry rz [rad], tx ty tz [m]) from one estimate of T_parent_child to another."""
    rotation = log_so3(T_after[..., :3, :3] @ np.swapaxes(T_before[..., :3, :3], -1, -2))
    return np.concatenate([rotation, T_after[..., :3, 3] - T_before[..., :3, 3]], axis=-1)


def changed(
    T: Float[np.ndarray, "*#batch 4 4"], change: Float[np.ndarray, "*#batch 6"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Apply a change to an estimate of T_parent_child; inverse of `change_between`."""
    R = exp_so3(change[..., :3]) @ T[..., :3, :3]
    return from_rotation_translation(R, T[..., :3, 3] + change[..., 3:])


def change_jacobian(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6 6"]:
    """d(change)/d(xi) for a left perturbation exp(xi) T: t moves by rho + omega x t (first order)."""
    J = np.broadcast_to(np.eye(6), (*T.shape[:-2], 6, 6)).copy()
    J[..., 3:, :3] = -hat(T[..., :3, 3])
    return J


def change_covariance(
    T: Float[np.ndarray, "*batch 4 4"], covariance: Float[np.ndarray, "*batch 6 6"]
) -> Float[np.ndarray, "*batch 6 6"]:
    """Covariance of (rotation vector, origin) of an estimate, given that of its left perturbation."""
    J = change_jacobian(T)
    return J @ covariance @ np.swapaxes(J, -1, -2)
