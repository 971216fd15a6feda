"""Rigid transforms as 4x4 arrays, with their covariances.

`T_a_b` takes coordinates in b to a. A twist is (rotation vector, translation). Perturbations are on the left:
`T' = exp(xi) T`, so xi is in the axes of the parent frame a.

Source: Sola, Deray, Atchuthan 2018, "A micro Lie theory for state estimation in robotics", section IV and
appendix D (their twist is translation first; here rotation comes first). SciPy turns vectors, quaternions and twists
into matrices and back; it has neither adjoints nor covariances of composed and inverted poses.

A change is (rotation vector, shift of the child's origin), both along the axes of the parent frame. Unlike the twist of
the left perturbation, its translation is the plain difference of the columns tx_m, ty_m, tz_m: a sensor that only
rotated in its bracket has no shift, for any lever arm.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

__all__ = [
    "adjoint", "camera_direction_angles", "change_between", "change_covariance", "change_jacobian", "changed",
    "compose_covariance", "exp_se3", "exp_so3", "from_quaternion", "from_rotation_translation",
    "from_spherical", "hat", "inverse", "log_se3", "log_so3", "perturb_exactly", "rotation_angle_rad",
    "spherical_jacobian", "to_quaternion", "to_spherical", "transform_points", "wrap_angle",
]  # fmt: skip


def hat(omega: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Skew-symmetric matrix with `hat(a) @ b = a x b`."""
    x, y, z = np.moveaxis(omega, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def exp_so3(phi: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    return Rotation.from_rotvec(_rows(phi, 3)).as_matrix().reshape(*phi.shape, 3)


def log_so3(R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Rotation vector [rad] of a rotation matrix, angle in [0, pi]; well conditioned everywhere."""
    return _rotations(R).as_rotvec().reshape(R.shape[:-1])


def exp_se3(xi: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Transform of a twist (rotation vector [rad], translation [m])."""
    return RigidTransform.from_exp_coords(_rows(xi, 6)).as_matrix().reshape(*xi.shape[:-1], 4, 4)


def log_se3(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """Twist of a transform, inverse of `exp_se3` for rotations below pi."""
    # By hand: SciPy's takes four times as long for many, and an error for what is not finite.
    phi = log_so3(T[..., :3, :3])
    half = np.linalg.norm(phi, axis=-1) / 2
    small = half < 5e-4  # the series is then exact to 1e-16
    h = np.where(small, 1.0, half)
    d = np.where(small, 1 / 3 + half * half / 45, (1 - h / np.tan(h)) / (h * h)) / 4
    W = hat(phi)
    V_inv = np.eye(3) - 0.5 * W + d[..., None, None] * (W @ W)
    return np.concatenate([phi, (V_inv @ T[..., :3, 3:])[..., 0]], axis=-1)


def from_rotation_translation(
    R: Float[np.ndarray, "*batch 3 3"], t: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """4x4 transform of R_a_b and t_a_b (b's origin seen in a, [m])."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T_a_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """T_b_a."""
    R = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return from_rotation_translation(R, -(R @ T_a_b[..., :3, 3:])[..., 0])


def transform_points(
    T_a_b: Float[np.ndarray, "4 4"], points_b: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Coordinates in a of points given in b [m]."""
    return points_b @ T_a_b[:3, :3].T.astype(points_b.dtype) + T_a_b[:3, 3].astype(points_b.dtype)


def adjoint(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6 6"]:
    """Ad with `T exp(xi) = exp(Ad xi) T`, for twists with the rotation first."""
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = R
    A[..., 3:, 3:] = R
    A[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return A


def compose_covariance(
    T_a_b: Float[np.ndarray, "4 4"], cov_a_b: Float[np.ndarray, "6 6"], cov_b_c: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Covariance of T_a_c = T_a_b T_b_c for independent errors (first order)."""
    A = adjoint(T_a_b)
    return cov_a_b + A @ cov_b_c @ A.T


def rotation_angle_rad(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """Angle of the rotation part [rad], in [0, pi]."""
    return np.asarray(np.linalg.norm(log_so3(T[..., :3, :3]), axis=-1))


def to_quaternion(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0."""
    q = _rotations(T[..., :3, :3]).as_quat(canonical=True, scalar_first=True)
    return q.reshape(*T.shape[:-2], 4)


def from_quaternion(
    q_wxyz: Float[np.ndarray, "*batch 4"], t: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Transform of a quaternion (w, x, y, z), normalised here, and a translation [m]; else ValueError."""
    norm = np.linalg.norm(q_wxyz, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-6):
        raise ValueError(f"no rotation: quaternion (w, x, y, z) = {q_wxyz}")
    R = Rotation.from_quat(_rows(q_wxyz, 4), scalar_first=True).as_matrix()
    return from_rotation_translation(R.reshape(*q_wxyz.shape[:-1], 3, 3), t)


def perturb_exactly(
    T: Float[np.ndarray, "4 4"], rotation_rad: float, translation_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """Rotate T by exactly `rotation_rad` and shift it by exactly `translation_m`, in random directions.

    The rotation acts about the parent's axes on the rotation part alone: both amounts are exact for any lever arm.
    """
    axis, direction = rng.normal(size=3), rng.normal(size=3)
    R = exp_so3(rotation_rad * axis / np.linalg.norm(axis)) @ T[:3, :3]
    return from_rotation_translation(R, T[:3, 3] + translation_m * direction / np.linalg.norm(direction))


def _rotations(R: np.ndarray) -> Rotation:
    """One axis of SciPy's rotations, taken as they are."""
    return Rotation.from_matrix(_rows(R, 3, 3), assume_valid=True)


def _rows(values: np.ndarray, *shape: int) -> np.ndarray:
    """A copy with one axis of rows, which SciPy computes in C; it refuses arrays that are read-only."""
    return np.array(values, np.float64).reshape(-1, *shape)


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
