"""Static radar detections against lidar points in torch: the log likelihood that `registration` climbs, at zero lag.

Every pair of a detection and a point counts (the compiled loop looks at neighbours within three sigmas), so frames
are thinned first.

Source: `pipeline.objective.registration`, whose sigmas and bounce prior are used here.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.objective.differentiable.poses import inverse, transform_points
from pipeline.objective.registration import BOUNCE_PRIOR, SIGMA_START

__all__ = ["static_cost"]

_RANGE_M = (3.0, 60.0)
_DETECTIONS, _POINTS = 96, 768  # of a frame at most: every pair of them is weighed
_LEAST_HEIGHT_M = 0.3  # what is lower mirrors onto itself


def static_cost(
    T_lidar_radar: Float[Tensor, "*batch #F 4 4"],
    radar: Float[Tensor, "F M 3"],
    radar_present: Bool[Tensor, "F M"],
    lidar: Float[Tensor, "F N 3"],
    lidar_present: Bool[Tensor, "F N"],
    plane: Float[Tensor, "F 4"],
    has_elevation: Bool[Tensor, " F"],
    *,
    widen: float = 1.0,
    outlier: float = 1.0,
    points: int = _POINTS,
) -> Float[Tensor, "*batch F"]:
    """Minus the mean log likelihood of a frame's static detections, each drawn from a lidar point or its mirror image.

    Args:
        T_lidar_radar: poses.
        radar: detections, radar frame.
        radar_present: which of them are static ones.
        lidar: points of the sweep, ground kept.
        lidar_present: which rows are points.
        plane: ground, n.p + d = 0 in the lidar frame; zeros = none.
        has_elevation: whether the radar measures it.
        widen: factor of the sigmas; wider ones make a wider basin.
        outlier: weight of "no lidar point", in units of one lidar point at distance 0.
        points: most lidar points of a frame; more are strided.
    """
    # Rows are in no order that matters once they are strided: each stands for its neighbours.
    thin, sparse = -(-radar.shape[1] // _DETECTIONS), -(-lidar.shape[1] // points)
    radar, radar_present = radar[:, ::thin], radar_present[:, ::thin]
    lidar, lidar_present = lidar[:, ::sparse], lidar_present[:, ::sparse]
    sigma = torch.tensor(SIGMA_START * widen, dtype=radar.dtype, device=radar.device)
    T_radar_lidar = inverse(T_lidar_radar)
    measured = _spherical(radar) / sigma
    seen = _spherical(transform_points(T_radar_lidar, lidar)) / sigma
    near = radar_present & (radar.norm(dim=-1) > _RANGE_M[0]) & (radar.norm(dim=-1) < _RANGE_M[1])
    plane = plane.to(lidar.dtype)
    height = (lidar * plane[:, None, :3]).sum(-1) + plane[:, None, 3]
    mirrored = lidar - 2 * height[..., None] * plane[:, None, :3]
    below = _spherical(transform_points(T_radar_lidar, mirrored))[..., 1] / sigma[1]
    delta = seen[..., None, :, :] - measured[:, :, None]  # *batch F M N 3
    flat = delta[..., 0].square() + delta[..., 2].square()
    use = has_elevation[:, None, None].to(flat.dtype)
    direct = flat + use * delta[..., 1].square()
    bounced = flat + (below[..., None, :] - measured[..., 1][:, :, None]).square()
    can_bounce = has_elevation[:, None, None] & ((height > _LEAST_HEIGHT_M) & lidar_present)[:, None]
    direct = (-0.5 * direct).masked_fill(~lidar_present[:, None], -1e4)
    bounced = (-0.5 * bounced).masked_fill(~can_bounce, -1e4)
    weight = (1 - BOUNCE_PRIOR) * direct.exp().sum(-1) + BOUNCE_PRIOR * bounced.exp().sum(-1)
    likelihood = torch.log(weight + outlier)
    count = near.sum(-1).clamp_min(1)
    return -(likelihood * near).sum(-1) / count


def _spherical(points: Tensor) -> Tensor:
    """Azimuth, elevation [rad], range [m], with finite slopes at the origin."""
    x, y, z = points.unbind(-1)
    h2 = x * x + y * y
    off = h2 > 1e-4
    h = torch.where(off, h2, torch.ones_like(h2)).sqrt()
    azimuth = torch.where(off, torch.atan2(y, torch.where(off, x, torch.ones_like(x))), torch.zeros_like(x))
    return torch.stack([azimuth, torch.atan2(z, h), (h * h + z * z).sqrt()], -1)
