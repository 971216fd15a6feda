"""Rigid transforms as 4x4 arrays, with their covariances.

`T_a_b` takes coordinates in b to a. A twist is (rotation vector, translation). Perturbations are on the left:
`T' = exp(xi) T`, so xi is in the axes of the parent frame a.

Source: Sola, Deray, Atchuthan 2018, "A micro Lie theory for state estimation in robotics", section IV and
appendix D (their twist is translation first; here rotation comes first). By hand because SciPy's rotations have
neither adjoints nor covariances of composed and inverted poses.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = [
    "adjoint",
    "compose_covariance",
    "exp_se3",
    "exp_so3",
    "from_quaternion",
    "from_rotation_translation",
    "hat",
    "inverse",
    "log_se3",
    "log_so3",
    "perturb_exactly",
    "rotation_angle_rad",
    "to_quaternion",
    "transform_points",
]

# Below this angle the series of sin(x)/x etc. to fourth order are exact to 1e-16.
_SMALL_RAD = 1e-3


def hat(omega: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Skew-symmetric matrix with `hat(a) @ b = a x b`."""
    x, y, z = np.moveaxis(omega, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def _series(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sin(t)/t, (1-cos t)/t^2, (t - sin t)/t^3, by Taylor series below _SMALL_RAD."""
    small = theta < _SMALL_RAD
    t = np.where(small, 1.0, theta)
    t2 = theta * theta
    a = np.where(small, 1 - t2 / 6 + t2 * t2 / 120, np.sin(t) / t)
    b = np.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, 2 * np.sin(t / 2) ** 2 / (t * t))
    c = np.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (t - np.sin(t)) / t**3)
    return a, b, c


def exp_so3(phi: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    theta = np.asarray(np.linalg.norm(phi, axis=-1))
    a, b, _ = _series(theta)
    W = hat(phi)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def log_so3(R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Rotation vector [rad] of a rotation matrix, angle in [0, pi]; well conditioned everywhere."""
    q = _quaternion_of_rotation(R)
    q = np.where(q[..., :1] < 0, -q, q)
    v = q[..., 1:]
    n = np.linalg.norm(v, axis=-1)
    small = n < 1e-9  # here angle/sin(angle/2) = 2 to 1e-18
    scale = np.where(small, 2.0, 2 * np.arctan2(n, q[..., 0]) / np.where(small, 1.0, n))
    return scale[..., None] * v


def exp_se3(xi: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Transform of a twist (rotation vector [rad], translation [m])."""
    phi, rho = xi[..., :3], xi[..., 3:]
    _, b, c = _series(np.asarray(np.linalg.norm(phi, axis=-1)))
    W = hat(phi)
    V = np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)
    return from_rotation_translation(exp_so3(phi), (V @ rho[..., None])[..., 0])


def log_se3(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """Twist of a transform, inverse of `exp_se3` for rotations below pi."""
    phi = log_so3(T[..., :3, :3])
    theta = np.asarray(np.linalg.norm(phi, axis=-1))
    a, b, _ = _series(theta)
    small = theta < _SMALL_RAD
    t2 = np.where(small, 1.0, theta * theta)
    d = np.where(small, 1 / 12 + theta * theta / 720, (1 - a / (2 * b)) / t2)
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
    q = _quaternion_of_rotation(T[..., :3, :3])
    return np.where(q[..., :1] < 0, -q, q)


def from_quaternion(
    q_wxyz: Float[np.ndarray, "*batch 4"], t: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Transform of a quaternion (w, x, y, z), normalised here, and a translation [m]; else ValueError."""
    norm = np.linalg.norm(q_wxyz, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-6):
        raise ValueError(f"no rotation: quaternion (w, x, y, z) = {q_wxyz}")
    w, x, y, z = np.moveaxis(q_wxyz / norm, -1, 0)
    R = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    return from_rotation_translation(R, t)


def perturb_exactly(
    T: Float[np.ndarray, "4 4"], rotation_rad: float, translation_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    """Rotate T by exactly `rotation_rad` and shift it by exactly `translation_m`, in random directions.

    The rotation acts about the parent's axes on the rotation part alone: both amounts are exact for any lever arm.
    """
    axis, direction = rng.normal(size=3), rng.normal(size=3)
    R = exp_so3(rotation_rad * axis / np.linalg.norm(axis)) @ T[:3, :3]
    return from_rotation_translation(R, T[:3, 3] + translation_m * direction / np.linalg.norm(direction))


def _quaternion_of_rotation(R: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) from the best-conditioned of the four branches (Shepperd 1978)."""
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Row k of the 4x4 matrix 4 q q^T; the row with the largest diagonal is far from zero.
    d01, d02, d12 = R[..., 1, 0] - R[..., 0, 1], R[..., 0, 2] - R[..., 2, 0], R[..., 2, 1] - R[..., 1, 2]
    s01, s02, s12 = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    rows = np.stack(
        [
            np.stack([1 + m00 + m11 + m22, d12, d02, d01], -1),
            np.stack([d12, 1 + m00 - m11 - m22, s01, s02], -1),
            np.stack([d02, s01, 1 - m00 + m11 - m22, s12], -1),
            np.stack([d01, s02, s12, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
