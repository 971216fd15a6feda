"""Values of frames' maps at projected points, differentiable in the pixel; and means over a frame's points."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

__all__ = ["bilinear", "bilinear_groups", "masked_mean", "nearest_pixel"]


def bilinear(
    maps: Shaped[Tensor, "F H W"],
    uv: Float[Tensor, "*batch F N 2"],
    valid: Bool[Tensor, "*batch F N"],
    outside: float,
) -> Float[Tensor, "*batch F N"]:
    """Map values at pixels; `outside` (without gradient) beyond the image's outermost pixel centres."""
    return bilinear_groups(maps[:, None], uv, valid, outside)[..., 0]


def bilinear_groups(
    maps: Shaped[Tensor, "F G H W"],
    uv: Float[Tensor, "*batch F N 2"],
    valid: Bool[Tensor, "*batch F N"],
    outside: float = 0.0,
) -> Float[Tensor, "*batch F N G"]:
    """Values of G maps of each frame at pixels; `outside` where not valid or beyond the image."""
    frames, groups, height, width = maps.shape
    at, a, b, inside = _cell(height, width, uv, valid)
    plane = torch.arange(frames, device=maps.device)[:, None] * (groups * height * width)
    # Groups last: the four neighbours are gathered for all of them at once.
    at = (plane + at)[..., None] + torch.arange(groups, device=maps.device) * (height * width)
    value = _between(maps.reshape(-1), at, width, a[..., None], b[..., None])
    return torch.where(inside[..., None], value, outside)


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


def _cell(height: int, width: int, uv: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Index of the upper left neighbour, distances from it to the right and down, and a mask of points inside."""
    u, v = uv.unbind(-1)
    inside = valid & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v = (torch.where(inside, q, torch.zeros_like(q)) for q in (u, v))
    # The last pixel belongs to the cell before it: all four neighbours exist.
    column, row = u.detach().long().clamp_max(width - 2), v.detach().long().clamp_max(height - 2)
    return row * width + column, u - column, v - row, inside


def _between(flat: Tensor, at: Tensor, width: int, a: Tensor, b: Tensor) -> Tensor:
    m00, m01, m10, m11 = (flat[at + step].to(a.dtype) for step in (0, 1, width, width + 1))
    top, bottom = m00 + a * (m01 - m00), m10 + a * (m11 - m10)
    return top + b * (bottom - top)
