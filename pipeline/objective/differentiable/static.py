"""Static radar detections against lidar points in torch: the likelihood of `registration`, without time lag.

The same neighbours (within three sigmas of azimuth and range), the same ground bounce, the same elevations
that count; frames are thinned first, because every detection is compared with every point.

Source: `pipeline.objective.radar.registration`, which gives the reasons and the constants.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.objective.differentiable.projection import inverse, transform_points
from pipeline.objective.radar.registration import (
    BOUNCE_PRIOR,
    RANGE_M,
    SIDE_RAD,
    SIGMA_START,
    STRAY,
    VIEW_MARGIN_RAD,
)
from pipeline.objective.radar.registration_neighbours import CUT

__all__ = ["StaticFrames", "elevation_limits", "static_cost", "tells_elevation"]

_DETECTIONS, _POINTS = 96, 768  # of a frame at most: every pair of them is weighed
_LEAST_HEIGHT_M = 0.3  # a lower point is as good as its own mirror image
_STEEPEST_RAD = 1.5
_NEVER = -1e4  # log weight of a point that the detection cannot have come from


@dataclass(frozen=True, eq=False)
class StaticFrames:
    """Static detections and lidar points of F frames."""

    radar: Float[Tensor, "F M 3"]  # detections, radar frame
    radar_present: Bool[Tensor, "F M"]  # which of them stand still
    lidar: Float[Tensor, "F N 3"]  # points of the sweep, lidar frame, ground kept
    lidar_present: Bool[Tensor, "F N"]  # which rows are points
    plane: Float[Tensor, "F 4"]  # ground, n.p + d = 0 in the lidar frame; zeros = none
    # Whose elevations count, from `tells_elevation`; the others are compared in azimuth and range alone.
    tells: Bool[Tensor, "*batch #F M"]


def static_cost(
    T_lidar_radar: Float[Tensor, "*batch #F 4 4"], frames: StaticFrames, *, outlier: float = 1.0,
    bounce_prior: float = BOUNCE_PRIOR, detections: int = _DETECTIONS, points: int = _POINTS,
) -> Float[Tensor, "*batch F"]:  # fmt: skip
    """Minus the mean log likelihood of a frame's static detections, each drawn from a lidar point or its mirror image.

    Args:
        outlier: weight of "no lidar point", in units of one lidar point at distance 0.
        bounce_prior: prior probability of a detection by reflection on the ground.
    """
    # Rows are in no order that matters once they are strided: each stands for its neighbours.
    thin, sparse = -(-frames.radar.shape[1] // detections), -(-frames.lidar.shape[1] // points)
    radar, radar_present = frames.radar[:, ::thin], frames.radar_present[:, ::thin]
    tells = frames.tells[..., ::thin, None]
    lidar, lidar_present = frames.lidar[:, ::sparse], frames.lidar_present[:, ::sparse]
    sigma = torch.tensor(SIGMA_START, dtype=radar.dtype, device=radar.device)
    T_radar_lidar = inverse(T_lidar_radar)
    measured = _spherical(radar) / sigma
    seen = _spherical(transform_points(T_radar_lidar, lidar)) / sigma
    plane = frames.plane.to(lidar.dtype)
    height = (lidar * plane[:, None, :3]).sum(-1) + plane[:, None, 3]
    mirrored = lidar - 2 * height[..., None] * plane[:, None, :3]
    below = _spherical(transform_points(T_radar_lidar, mirrored))[..., 1] / sigma[1]
    delta = seen[..., None, :, :] - measured[:, :, None]  # *batch F M N 3
    flat = delta[..., 0].square() + delta[..., 2].square()
    reached = lidar_present[:, None] & (flat <= CUT)
    bounces = reached & tells & (height > _LEAST_HEIGHT_M)[:, None]
    direct = flat + tells.to(flat.dtype) * delta[..., 1].square()
    bounced = flat + (below[..., None, :] - measured[..., 1][:, :, None]).square()
    direct = (-0.5 * direct).masked_fill(~reached, _NEVER).exp().sum(-1)
    bounced = (-0.5 * bounced).masked_fill(~bounces, _NEVER).exp().sum(-1)
    likelihood = torch.log((1 - bounce_prior) * direct + bounce_prior * bounced + outlier)
    over_ground, azimuth = radar[..., :2].norm(dim=-1), torch.atan2(radar[..., 1], radar[..., 0])
    is_near = (over_ground > RANGE_M[0]) & (over_ground < RANGE_M[1])
    counts = radar_present & is_near & (azimuth.abs() < SIDE_RAD)
    return -(likelihood * counts).sum(-1) / counts.sum(-1).clamp_min(1)


def tells_elevation(
    T_lidar_radar: Float[Tensor, "*batch #F 4 4"],
    radar: Float[Tensor, "F M 3"],
    has_elevation: Bool[Tensor, " F"],
    limits_rad: Float[Tensor, "F 2"],
) -> Bool[Tensor, "*batch F M"]:
    """Detections whose elevation can be compared with the lidar's: others would be matched to the edge of its view.

    The registration decides this at every pose and keeps the decision constant in its step. A minimiser of
    the value should decide only once, because a rotation that moves detections out of the limits would reduce
    the cost.
    """
    limits_rad = limits_rad.to(radar.dtype)
    reach = (0.25 * (limits_rad[:, 1] - limits_rad[:, 0])).clamp_max(2 * float(SIGMA_START[1]))
    inner = limits_rad + torch.stack([VIEW_MARGIN_RAD + reach, -VIEW_MARGIN_RAD - reach], -1)
    slope = torch.tan(inner.clamp(-_STEEPEST_RAD, _STEEPEST_RAD))[:, None]
    points = transform_points(T_lidar_radar, radar)
    flat, up = points[..., :2].norm(dim=-1), points[..., 2]
    return (slope[..., 0] * flat < up) & (up < slope[..., 1] * flat) & has_elevation[:, None]


def elevation_limits(
    lidar: Float[Tensor, "F N 3"], lidar_present: Bool[Tensor, "F N"]
) -> Float[Tensor, "F 2"]:
    """Lowest and highest elevation [rad] of each frame's points, without a few outliers.

    The estimator uses the limits of a whole day; a single frame covers less of the lidar's view.
    """
    angle = torch.atan2(lidar[..., 2], lidar[..., :2].norm(dim=-1))
    away = torch.full_like(angle, torch.inf)
    stray = (lidar_present.sum(-1, keepdim=True) // STRAY).clamp_max(angle.shape[1] - 1)
    low = torch.where(lidar_present, angle, away).sort(-1).values.gather(-1, stray)
    high = torch.where(lidar_present, -angle, away).sort(-1).values.gather(-1, stray)
    found = torch.cat([low, -high], -1)
    return torch.where(found.isfinite(), found, found.new_tensor([-_STEEPEST_RAD, _STEEPEST_RAD]))


def _spherical(points: Tensor) -> Tensor:
    """Azimuth, elevation [rad], range [m], with finite slopes at the origin."""
    x, y, z = points.unbind(-1)
    h2 = x * x + y * y
    off = h2 > 1e-4
    h = torch.where(off, h2, torch.ones_like(h2)).sqrt()
    azimuth = torch.where(off, torch.atan2(y, torch.where(off, x, torch.ones_like(x))), torch.zeros_like(x))
    return torch.stack([azimuth, torch.atan2(z, h), (h * h + z * z).sqrt()], -1)
