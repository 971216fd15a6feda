"""Small damped least squares inside a network: differentiable, batched, and made of operations that ONNX has."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.objective.differentiable.projection import exp_so3

__all__ = ["Match", "angular_jacobian", "damped_match", "small_rotation_vector", "spherical_jacobian"]


@dataclass(frozen=True, eq=False)
class Match:
    """Result of a matcher: left twist, its variance, and log-probabilities of shifts."""

    twist: Float[Tensor, "B 6"]  # rotation vector [rad], translation [m]
    variance: Float[Tensor, "B 6"]
    surfaces: Float[Tensor, "B S"]


def damped_match(
    J: Float[Tensor, "B N R 6"], information: Float[Tensor, "B N R"], gradient: Float[Tensor, "B N R"],
    log_prior_sigma: Float[Tensor, " 6"], R: Float[Tensor, "B 3 3"], surfaces: Float[Tensor, "B S"],
) -> Match:  # fmt: skip
    """One step of least squares behind a rotation R that the search has found.

    Args:
        J: derivative of the predictions by a left twist.
        gradient: measured less predicted, times the information.
        log_prior_sigma: of the step, as logarithm [rad, m].
    """
    identity, rows = torch.eye(6, device=J.device), J.flatten(1, 2).transpose(1, 2)
    H = (rows * information.flatten(1)[:, None]) @ J.flatten(1, 2)
    covariance = _inverse_spd(H + identity * torch.exp(-2 * log_prior_sigma))
    step = (covariance @ (rows @ gradient.flatten(1)[..., None]))[..., 0]
    twist = torch.cat([small_rotation_vector(exp_so3(step[:, :3]) @ R), step[:, 3:]], -1)
    return Match(twist, (covariance * identity).sum(-1), surfaces)


def _inverse_spd(H: Float[Tensor, "B P P"]) -> Float[Tensor, "B P P"]:
    """Inverse of symmetric positive definite matrices by Gauss-Jordan elimination, which needs no pivoting there."""
    size = H.shape[-1]
    identity = torch.eye(size, dtype=H.dtype, device=H.device).expand_as(H)
    rows = torch.cat([H, identity], -1)
    for k in range(size):
        pivot = rows[:, k : k + 1] / rows[:, k : k + 1, k : k + 1]
        below = rows - rows[:, :, k : k + 1] * pivot
        rows = torch.cat([below[:, :k], pivot, below[:, k + 1 :]], 1)
    return rows[:, :, size:]


def angular_jacobian(
    directions: Float[Tensor, "B N 3"], inverse_range: Float[Tensor, "B N"]
) -> Float[Tensor, "B N 2 6"]:
    """d(azimuth, elevation) of points in the optical frame by a left twist (rotation vector, translation).

    `directions` are unit vectors, not on the axis of the poles; `inverse_range` is in 1/m.
    """
    x, y, z = directions.unbind(-1)
    h = torch.sqrt(x * x + z * z)
    o = torch.zeros_like(x)
    # azimuth = atan2(-x, z), elevation = atan2(-y, h)
    d_azimuth = torch.stack([-z / (h * h), o, x / (h * h)], -1)
    d_elevation = torch.stack([x * y / h, -h, z * y / h], -1)
    return _with_rotation(torch.stack([d_azimuth, d_elevation], -2), directions, inverse_range)


def spherical_jacobian(
    directions: Float[Tensor, "B N 3"], range_m: Float[Tensor, "B N"]
) -> Float[Tensor, "B N 3 6"]:
    """d(azimuth, elevation, range) of points in a frame with x forward, z up by a twist on the left."""
    x, y, z = directions.unbind(-1)
    h = torch.sqrt((x * x + y * y).clamp(min=1e-6))
    o = torch.zeros_like(x)
    d_azimuth = torch.stack([-y / (h * h), x / (h * h), o], -1)
    d_elevation = torch.stack([-x * z / h, -y * z / h, h], -1)
    by_direction = torch.stack([d_azimuth, d_elevation], -2)
    angles = _with_rotation(by_direction, directions, 1 / range_m.clamp(min=0.5))
    d_range = torch.cat([torch.zeros_like(directions), directions], -1)
    return torch.cat([angles, d_range[..., None, :]], -2)


def _with_rotation(by_direction: Tensor, directions: Tensor, inverse_range: Tensor) -> Tensor:
    """Rows by direction (B N R 3) to rows by twist: a rotation w moves d by w x d, a translation t by t/range."""
    # row . (w x d) = w . (d x row), written out: cross products of broadcast tensors trouble some exporters
    a, b, c = by_direction.unbind(-1)
    dx, dy, dz = directions[..., None, :].unbind(-1)
    turn = torch.stack([dy * c - dz * b, dz * a - dx * c, dx * b - dy * a], -1)
    return torch.cat([turn, by_direction * inverse_range[..., None, None]], -1)


def small_rotation_vector(R: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 3"]:
    """Rotation vector of rotations well below 90 deg, from the sine alone."""
    skew = torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    square = (skew * skew).sum(-1, keepdim=True).clamp(max=0.998)
    # asin(s)/s by its series to s^7: below 1e-8 up to 12 deg, 1e-5 up to 30 deg, and smooth at zero.
    return skew * (1 + square * (1 / 6 + square * (3 / 40 + square * (15 / 336 + square * 105 / 3456))))
