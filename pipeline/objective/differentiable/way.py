"""The car's way as a term of self-supervision: the radar's velocity by Doppler points along the road.

It needs no match of detections, so it says where a radar points whose elevations are too noisy to be matched. What is
measured, and what it took: `pipeline.objective.radar.travel`, whose residual this is, with a gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["way_cost"]

_DEG = 180.0 / torch.pi
# What frames differ by beyond the sigma of their scan (springs, road): 0.3 to 0.9 deg in simulation, 1.7 on a real day.
_SCATTER_DEG = 1.0
_ROUND_DEG = 0.05  # below this the absolute value is rounded off
_LEAST_MPS = 1.0  # any speed: unknown ones are zeros


def way_cost(
    T_lidar_radar: Float[Tensor, "*batch #F 4 4"],
    velocity_mps: Float[Tensor, "F 3"],
    sigma_rad: Float[Tensor, " F"],
    slope: Float[Tensor, " F"],
) -> Float[Tensor, "*batch F"]:
    """How far the velocity points above or below the road [deg], frames of wide sigma less; 0 where it is not known.

    Absolute values, not squares: in the median over frames a bump or a bridge counts no more than a good road.

    Args:
        T_lidar_radar: answers.
        velocity_mps: of the radar, its own axes.
        sigma_rad: of the velocity's elevation; 0 = unknown.
        slope: of the road along the velocity, lidar axes, up positive.
    """
    known = sigma_rad > 0
    forward = torch.zeros_like(velocity_mps)
    forward[..., 0] = _LEAST_MPS
    own = torch.where(known[:, None], velocity_mps, forward)
    x, y, z = (T_lidar_radar[..., :3, :3] @ own[..., None])[..., 0].unbind(-1)
    flat = (x * x + y * y).clamp(min=1e-6).sqrt()
    off_deg = (torch.atan2(z, flat) - torch.atan(slope)) * _DEG
    cost = (off_deg.square() + _ROUND_DEG**2).sqrt() - _ROUND_DEG
    weight = _SCATTER_DEG / ((sigma_rad * _DEG).square() + _SCATTER_DEG**2).sqrt()
    return cost * weight * known
