"""Directed edges in torch: residuals of depth jumps to mask boundaries.

Source: `pipeline.objective.camera_lidar.edges`, which has the reasons; the same nearest-pixel lookup.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int8, Int64
from torch import Tensor

from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY
from pipeline.objective.differentiable.lookup import nearest_pixel

__all__ = ["edge_residuals_px"]


def edge_residuals_px(
    offsets: Int8[Tensor, "F 4 H W"],
    uv: Float[Tensor, "*batch F N 2"],
    seen: Bool[Tensor, "*batch F N"],
    side: Int64[Tensor, "F N"],
    *,
    step_px: float = 1.0,
    shift_px: float = 0.5,
) -> tuple[Float[Tensor, "*batch F N"], Bool[Tensor, "*batch F N"]]:
    """Signed way along its own axis from each jump to the nearest boundary of its direction class.

    Args:
        offsets: way from a pixel's centre to the boundary, in steps.
        uv: projected jumps.
        seen: which of them mean something.
        side: direction class, EDGE_LEFT/RIGHT/ABOVE/BELOW.
        step_px: pixels per step of `offsets`.
        shift_px: what to add; the kernels' maps hold k for k + 1/2.

    Returns:
        Residuals [px], and which jumps lie in the image with a boundary in reach.
    """
    row, column, inside = nearest_pixel((offsets.shape[2], offsets.shape[3]), uv, seen)
    frame = torch.arange(len(offsets), device=uv.device)[:, None]
    offset = offsets[frame, side, row, column]
    sideways = side < 2
    centre = torch.where(sideways, column, row).to(uv.dtype)
    at = torch.where(sideways, uv[..., 0], uv[..., 1])
    return offset.to(uv.dtype) * step_px + shift_px + (centre - at), inside & (offset != NO_BOUNDARY)
