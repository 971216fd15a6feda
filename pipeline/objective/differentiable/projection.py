"""Projection of points into images of several frames, differentiable: camera models and the equirectangular grid.

Both take a frame's points to map pixels (u right, v down, (0, 0) = centre of the first pixel), for any kind
of map. Models are exact, as in `pipeline.rig.cameras`; the compiled kernels fit polynomials to them.
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
    "CameraProjection",
    "GridProjection",
    "bilinear",
    "camera_projection",
    "masked_mean",
    "nearest_pixel",
]

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
