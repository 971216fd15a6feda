"""Projection of points into images of several frames, differentiable: camera models and the equirectangular grid.

Both take a frame's points to map pixels (u right, v down, (0, 0) = centre of the first pixel), for any kind
of map. Models are exact, as in `pipeline.rig.cameras`; the compiled kernels fit polynomials to them.

Rigid transforms as torch tensors, differentiable everywhere: twists, Euler angles, the loop of the three pairs.

The same conventions as `pipeline.rig.se3`: twist = (rotation vector [rad], translation [m]),
perturbations on the left. Shapes are `*batch`, for any batch of the caller.

Source: paper section 4.4, equation 1, for the loop loss; Sola et al. 2018 for the exponential maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from pipeline.rig.cameras import Camera

__all__ = [
    "CameraProjection", "GridProjection", "bilinear", "camera_projection", "euler_angles", "exp_so3",
    "inverse", "loop_loss", "masked_mean", "nearest_pixel", "pose", "pose_of_euler_angles",
    "transform_points",
]  # fmt: skip

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
    T_camera_lidar: Float[Tensor, "*batch 4 4"], T_lidar_radar: Float[Tensor, "*batch 4 4"],
    T_camera_radar: Float[Tensor, "*batch 4 4"], *, angle_unit: float = 1.0, metre_unit: float = 1.0,
) -> Float[Tensor, "*batch"]:  # fmt: skip
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


NEAR_M = 0.5  # as in the kernels: nothing outside the car is nearer


@dataclass(frozen=True, eq=False)
class CameraProjection:
    """Cameras of F frames, of one model."""

    model: str
    focal: Float[Tensor, "F 2"]
    centre: Float[Tensor, "F 2"]
    distortion: Float[Tensor, "F 8"]
    max_angle_rad: Float[Tensor, " F"]

    def project(
        self, points_camera: Float[Tensor, "*batch F N 3"]
    ) -> tuple[Float[Tensor, "*batch F N 2"], Bool[Tensor, "*batch F N"]]:
        """Pixels of points, and a mask of valid ones."""
        distort = _equidistant if self.model == "equidistant" else _pinhole
        xy, valid = distort(points_camera, self.distortion[:, None], self.max_angle_rad[:, None])
        return xy * self.focal[:, None] + self.centre[:, None], valid


@dataclass(frozen=True, eq=False)
class GridProjection:
    """An equirectangular grid about the optical axis: a rotation error is a shift.

    Args:
        left_rad: azimuth (right positive) of the centres of the first column.
        top_rad: elevation (down positive) of the centres of the first row.
        step_rad: cell size.
    """

    left_rad: float
    top_rad: float
    step_rad: float

    def project(
        self, points_camera: Float[Tensor, "*batch F N 3"]
    ) -> tuple[Float[Tensor, "*batch F N 2"], Bool[Tensor, "*batch F N"]]:
        """Cells of points, and a mask of valid ones: points on the axis through the poles have no azimuth."""
        x, y, z = points_camera.unbind(-1)
        h2 = x * x + z * z
        valid = (h2 > NEAR_M**2) & (z > 0)
        h = torch.where(valid, h2, torch.ones_like(h2)).sqrt()
        azimuth = torch.atan2(x, torch.where(valid, z, torch.ones_like(z)))
        elevation = torch.atan2(y, h)
        u, v = (azimuth - self.left_rad) / self.step_rad, (elevation - self.top_rad) / self.step_rad
        return torch.stack([u, v], -1), valid


def camera_projection(cameras: Sequence[Camera], dtype: torch.dtype = torch.float32) -> CameraProjection:
    """The cameras of F frames as tensors; ValueError for cameras of different models."""
    kinds = {c.model == "equidistant" for c in cameras}
    if len(kinds) != 1:
        raise ValueError("the cameras of a batch must all be equidistant, or none of them")
    distortion = np.zeros((len(cameras), 8))
    for row, camera in zip(distortion, cameras, strict=True):
        row[: len(camera.D)] = camera.D

    def tensor(values: object) -> Tensor:
        return torch.tensor(np.asarray(values, np.float64), dtype=dtype)

    return CameraProjection(
        "equidistant" if kinds.pop() else "plumb_bob",
        tensor([c.focal_px for c in cameras]),
        tensor([c.centre_px for c in cameras]),
        tensor(distortion),
        tensor([c.max_angle_rad for c in cameras]),
    )


def _pinhole(points: Tensor, d: Tensor, max_angle: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = points.unbind(-1)
    ahead = z > NEAR_M
    safe = torch.where(ahead, z, torch.ones_like(z))
    a, b = (torch.where(ahead, q, torch.zeros_like(q)) / safe for q in (x, y))
    r2 = a * a + b * b
    valid = ahead & (r2 <= torch.tan(max_angle) ** 2)
    # What lies beyond the model must not overflow its gradient.
    a, b, r2 = (torch.where(valid, q, torch.zeros_like(q)) for q in (a, b, r2))
    k1, k2, p1, p2, k3, k4, k5, k6 = d.unbind(-1)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return torch.stack([u, v], -1), valid


def _equidistant(points: Tensor, d: Tensor, max_angle: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = points.unbind(-1)
    h2 = x * x + y * y
    off_axis = h2 > 1e-12 * z * z
    h = torch.where(off_axis, h2, torch.ones_like(h2)).sqrt()
    theta = torch.where(off_axis, torch.atan2(h, z), torch.zeros_like(z))
    t2 = theta * theta
    k1, k2, k3, k4 = d.unbind(-1)[:4]
    radius = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    ahead = (z > 0) | off_axis
    k = torch.where(off_axis, radius / h, 1 / torch.where(z > NEAR_M, z, torch.ones_like(z)))
    far = h2 + z * z > NEAR_M**2
    return torch.stack([k * x, k * y], -1), ahead & far & (theta <= max_angle)


def bilinear(
    maps: Shaped[Tensor, "F H W"],
    uv: Float[Tensor, "*batch F N 2"],
    valid: Bool[Tensor, "*batch F N"],
    outside: float,
) -> Float[Tensor, "*batch F N"]:
    """Map values at pixels; `outside` (without gradient) beyond the image's outermost pixel centres."""
    frames, height, width = maps.shape
    u, v = uv.unbind(-1)
    inside = valid & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v = (torch.where(inside, q, torch.zeros_like(q)) for q in (u, v))
    # The last pixel belongs to the cell before it: all four neighbours exist.
    column, row = u.detach().long().clamp_max(width - 2), v.detach().long().clamp_max(height - 2)
    frame = torch.arange(frames, device=maps.device)[:, None]
    at, flat = (frame * height + row) * width + column, maps.reshape(-1)
    m00, m01, m10, m11 = (flat[at + step].to(u.dtype) for step in (0, 1, width, width + 1))
    a, b = u - column, v - row
    top, bottom = m00 + a * (m01 - m00), m10 + a * (m11 - m10)
    return torch.where(inside, top + b * (bottom - top), outside)


def nearest_pixel(
    size: tuple[int, int], uv: Float[Tensor, "*batch F N 2"], valid: Bool[Tensor, "*batch F N"]
) -> tuple[Int64[Tensor, "*batch F N"], Int64[Tensor, "*batch F N"], Bool[Tensor, "*batch F N"]]:
    """Row, column and whether inside, of an image of (height, width)."""
    height, width = size
    u, v = uv.detach().unbind(-1)
    inside = valid & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    column, row = (torch.where(inside, q + 0.5, torch.zeros_like(q)).long() for q in (u, v))
    return row, column, inside


def masked_mean(
    values: Float[Tensor, "*batch F N"], present: Bool[Tensor, "F N"]
) -> Float[Tensor, "*batch F"]:
    """Mean over the valid points of a frame, 0 without any."""
    weight = present.to(values.dtype)
    return (values * weight).sum(-1) / weight.sum(-1).clamp_min(1)
