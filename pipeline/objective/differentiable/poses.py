"""Rigid transforms as torch tensors, differentiable everywhere: twists, Euler angles, the loop of the three pairs.

The same conventions as `pipeline.rig.se3`: twist = (rotation vector [rad], translation [m]),
perturbations on the left. Shapes are `*batch`, for any batch of the caller.

Source: paper section 4.4, equation 1, for the loop loss; Sola et al. 2018 for the exponential maps.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = [
    "euler_angles",
    "exp_so3",
    "inverse",
    "loop_loss",
    "pose",
    "pose_of_euler_angles",
    "transform_points",
]

# Below this squared angle the series to second order in t^2 are exact to float32; and sqrt has no gradient at zero.
_SMALL_RAD2 = 1e-4


def hat(omega: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Skew-symmetric matrix with `hat(a) @ b = a x b`."""
    x, y, z = omega.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*omega.shape, 3)


def exp_so3(phi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    a, b = _series(phi)
    W = hat(phi)
    return torch.eye(3, dtype=phi.dtype, device=phi.device) + a * W + b * (W @ W)


def pose(R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """4x4 transform of R_a_b and t_a_b (b's origin seen in a, [m])."""
    upper = torch.cat([R, t[..., None]], -1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(*R.shape[:-2], 1, 4)
    return torch.cat([upper, last], -2)


def pose_of_euler_angles(
    angles: Float[Tensor, "*batch 3"], t: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Transform of roll, pitch, yaw [rad] (R = Rz(yaw) Ry(pitch) Rx(roll), as `euler_angles` gives them) and t."""
    (sr, sp, sy), (cr, cp, cy) = torch.sin(angles).unbind(-1), torch.cos(angles).unbind(-1)
    R = torch.stack(
        [
            cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
            sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
            -sp, cp * sr, cp * cr,
        ],
        -1,
    )  # fmt: skip
    return pose(R.reshape(*angles.shape, 3), t)


def inverse(T_a_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """T_b_a."""
    R = T_a_b[..., :3, :3].transpose(-1, -2)
    return pose(R, -(R @ T_a_b[..., :3, 3:])[..., 0])


def transform_points(
    T_a_b: Float[Tensor, "*poses 4 4"], points_b: Float[Tensor, "*frames N 3"]
) -> Float[Tensor, "*shape N 3"]:
    """Coordinates in a of points given in b [m]; the two batches broadcast."""
    return points_b @ T_a_b[..., :3, :3].transpose(-1, -2) + T_a_b[..., None, :3, 3]


def euler_angles(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 3"]:
    """Roll, pitch, yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-pi/2, pi/2]."""
    return torch.stack(
        [
            torch.atan2(T[..., 2, 1], T[..., 2, 2]),
            -torch.asin(T[..., 2, 0].clamp(-1, 1)),
            torch.atan2(T[..., 1, 0], T[..., 0, 0]),
        ],
        -1,
    )


def loop_loss(
    T_camera_lidar: Float[Tensor, "*batch 4 4"],
    T_lidar_radar: Float[Tensor, "*batch 4 4"],
    T_camera_radar: Float[Tensor, "*batch 4 4"],
    *,
    angle_unit: float = 1.0,
    metre_unit: float = 1.0,
) -> Float[Tensor, "*batch"]:
    """l1 norm of Euler angles and translation of the loop T_camera_lidar T_lidar_radar T_camera_radar^-1.

    The units are factors [1/rad] and [1/m]; the paper names none, so 1 as in `pipeline.objective.paper.classes`.
    """
    loop = T_camera_lidar @ T_lidar_radar @ inverse(T_camera_radar)
    return angle_unit * euler_angles(loop).abs().sum(-1) + metre_unit * loop[..., :3, 3].abs().sum(-1)


def _series(phi: Tensor) -> tuple[Tensor, Tensor]:
    """sin(t)/t, (1 - cos t)/t^2 of t = |phi|, with two axes for matrices."""
    t2 = (phi * phi).sum(-1)[..., None, None]
    small = t2 < _SMALL_RAD2
    safe2 = torch.where(small, torch.ones_like(t2), t2)
    t = safe2.sqrt()
    a = torch.where(small, 1 - t2 / 6 + t2 * t2 / 120, torch.sin(t) / t)
    b = torch.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, 2 * torch.sin(t / 2) ** 2 / safe2)
    return a, b
