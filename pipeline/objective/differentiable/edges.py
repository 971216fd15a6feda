"""Directed edges in torch: residuals of depth jumps to mask boundaries, and `joint`'s likelihood score of them.

Source: `pipeline.objective.camera_lidar.edges`, which has the reasons; the same constants, the same
nearest-pixel lookup.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int8, Int64
from torch import Tensor

from pipeline.objective.camera_lidar.edges import CHANCE_BINS
from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY
from pipeline.objective.differentiable.lookup import nearest_pixel

__all__ = ["edge_residuals_px", "edge_scores"]


def edge_residuals_px(
    offsets: Int8[Tensor, "F 4 H W"],
    uv: Float[Tensor, "*batch F N 2"],
    seen: Bool[Tensor, "*batch F N"],
    side: Int64[Tensor, "F N"],
    *,
    step_px: float = 1.0,
    shift_px: float = 0.5,
) -> tuple[Float[Tensor, "*batch F N"], Bool[Tensor, "*batch F N"], Bool[Tensor, "*batch F N"]]:
    """Signed way along its own axis from each jump to the nearest boundary of its direction class.

    Args:
        offsets: way from a pixel's centre to the boundary, in steps.
        uv: projected jumps.
        seen: which of them mean something.
        side: direction class, EDGE_LEFT/RIGHT/ABOVE/BELOW.
        step_px: pixels per step of `offsets`.
        shift_px: what to add; the kernels' maps hold k for k + 1/2.

    Returns:
        Residuals [px], which jumps lie in the image, and which of these have a boundary in reach.
    """
    row, column, inside = nearest_pixel((offsets.shape[2], offsets.shape[3]), uv, seen)
    frame = torch.arange(len(offsets), device=uv.device)[:, None]
    offset = offsets[frame, side, row, column]
    sideways = side < 2
    centre = torch.where(sideways, column, row).to(uv.dtype)
    at = torch.where(sideways, uv[..., 0], uv[..., 1])
    return offset.to(uv.dtype) * step_px + shift_px + (centre - at), inside, inside & (offset != NO_BOUNDARY)


def edge_scores(
    residual_px: Float[Tensor, "*batch F N"],
    inside: Bool[Tensor, "*batch F N"],
    found: Bool[Tensor, "*batch F N"],
    sigma_px: Float[Tensor, "F N"],
    match: Float[Tensor, "F N"],
    chance: Float[Tensor, "F N B"],
) -> Float[Tensor, "*batch F N"]:
    """Log likelihood ratio of each jump: a match of share `match` and kernel (1 + (r/s)^2)^-2, against chance.

    Args:
        residual_px: from `edge_residuals_px`.
        inside: from there; jumps outside the image count 0.
        found: from there.
        sigma_px: scale of each jump's kernel.
        match: share of jumps of its kind that match.
        chance: density of |r| at random places of its kind [1/px], by bins of a pixel.
    """
    bins = residual_px.detach().abs().long().clamp_max(CHANCE_BINS - 1)
    at_chance = torch.gather(chance.expand(*bins.shape, chance.shape[-1]), -1, bins[..., None])[..., 0]
    # Rows that are padding have no sigma and no chance; what is not chosen must stay finite for autograd.
    one = torch.ones_like(residual_px)
    sigma_px, at_chance = torch.where(found, sigma_px, one), torch.where(found, at_chance, one)
    q = 1 + (residual_px / sigma_px).square()
    # 2/pi makes the kernel a density
    matched = match * (2 / torch.pi) / (sigma_px * q * q * at_chance)
    score = torch.log(1 - match + torch.where(found, matched, torch.zeros_like(matched)))
    return torch.where(inside, score, torch.zeros_like(score))
