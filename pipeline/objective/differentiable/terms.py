"""Terms of self-supervision on the equirectangular grid: the terms of `joint`, as smooth costs of single frames.

Angles are in degrees, distances in metres. Costs are means per frame over valid entries, so that terms and
frames are comparable. Every function takes the poses of its own pair, `*batch #F 4 4`, and tensors of F
frames.

Source: the project's study of self-supervision, section 3 (which terms have their minimum at the truth).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8, Int64
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY
from pipeline.objective.differentiable.projection import (
    GridProjection,
    exp_so3,
    inverse,
    masked_mean,
    nearest_pixel,
    pose,
    transform_points,
)
from pipeline.objective.radar.registration import SIGMA_START

__all__ = [
    "GridMaps", "RadarTracks", "class_evidence_cost", "edge_cost", "edge_residuals_px", "track_cluster_cost",
    "track_detection_cost",
]  # fmt: skip

DEG = 180.0 / torch.pi
EDGE_CLAMP_DEG = 4.0  # evidence: convex to +-4 deg
# Most jumps match no boundary. What they add to a wide cost biases it (roll by 0.3, yaw by 0.15 deg on a simulated
# highway). Sharp kernels of the shape that `camera_lidar.edges` uses halve that; a share of the wide one leads to them.
_EDGE_SCALES_DEG = (0.3, 1.0)
_EDGE_FAR_WEIGHT = 0.25
DETECTION_TAU_DEG, DETECTION_CLAMP_DEG = 0.5, 8.0
CLUSTER_TAU_M, CLUSTER_CLAMP_M = 0.3, 5.0
# Weight of elevation: azimuth sigma over elevation sigma of a radar; ground bounce biases elevations as well.
_ELEVATION_WEIGHT = float(SIGMA_START[0] / SIGMA_START[1])
OFFSET_STEP_DEG = 0.05  # of the stored maps
# Poses beside the reference: standard deviation of their turns about the camera's axes (right, down, ahead), and how
# many, each with its opposite.
_BESIDE_DEG, _BESIDE_M, _BESIDE = (0.5, 0.5, 1.0), (0.1, 0.1, 0.2), 6  # sigmas in camera axes, and how many
_EVIDENCE_WORTH = 30.0  # of a frame's mean log-likelihood, as days of it show


@dataclass(frozen=True, eq=False)
class GridMaps:
    """Maps of F frames on one equirectangular grid in the optical frame; steps as in `schemas.training`."""

    edge_offset: Int8[Tensor, "F 4 H W"]
    seen: Bool[Tensor, "F H W"]  # the camera sees this cell
    projection: GridProjection

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.seen.shape[1], self.seen.shape[2]

    def pixels(
        self, T_camera_points: Float[Tensor, "*batch #F 4 4"], points: Float[Tensor, "F N 3"]
    ) -> tuple[Float[Tensor, "*batch F N 2"], Bool[Tensor, "*batch F N"]]:
        """Cells of points, and a mask of those that the camera sees."""
        uv, valid = self.projection.project(transform_points(T_camera_points, points))
        row, column, inside = nearest_pixel(self.size, uv, valid)
        frame = torch.arange(len(self.seen), device=uv.device)[:, None]
        return uv, inside & self.seen[frame, row, column]


def edge_cost(
    maps: GridMaps,
    T_camera_lidar: Float[Tensor, "*batch #F 4 4"],
    points: Float[Tensor, "F N 3"],
    side: Int64[Tensor, "F N"],
    present: Bool[Tensor, "F N"],
) -> Float[Tensor, "*batch F"]:
    """Robust distance of depth jumps to mask boundaries of the same direction, along that direction's axis."""
    uv, seen = maps.pixels(T_camera_lidar, points)
    step_deg = maps.projection.step_rad * DEG
    residual, found = edge_residuals_px(
        maps.edge_offset, uv, seen, side, step_px=OFFSET_STEP_DEG / step_deg, shift_px=0.0
    )
    way = (residual * step_deg).abs()
    far = torch.where(found, soft_clamp(way, EDGE_CLAMP_DEG), torch.full_like(way, EDGE_CLAMP_DEG))
    cost = _EDGE_FAR_WEIGHT * far
    for scale_deg in _EDGE_SCALES_DEG:
        score = (1 + (way / scale_deg).square()) ** -2
        cost = cost + 1 - torch.where(found, score, torch.zeros_like(score))
    return masked_mean(cost, present)


def edge_residuals_px(
    offsets: Int8[Tensor, "F 4 H W"], uv: Float[Tensor, "*batch F N 2"], seen: Bool[Tensor, "*batch F N"],
    side: Int64[Tensor, "F N"], *, step_px: float = 1.0, shift_px: float = 0.5,
) -> tuple[Float[Tensor, "*batch F N"], Bool[Tensor, "*batch F N"]]:  # fmt: skip
    """Signed distance along its own axis from each jump to the nearest boundary of its direction class.

    As in `pipeline.objective.camera_lidar.edges`, which gives the reasons.

    Args:
        offsets: distance from a pixel's centre to the boundary, in steps.
        step_px: pixels per step of `offsets`.
        shift_px: offset to add, because the kernels' maps store k for k + 1/2.

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


def class_evidence_cost(
    projection: GridProjection, points_camera: Float[Tensor, "F N 3"], maps: Float[Tensor, "F K H W"],
    probability: Float[Tensor, "F N K"], weight: Float[Tensor, "F N"], generator: torch.Generator,
) -> Float[Tensor, ""]:  # fmt: skip
    """Negative log-probability of a reference pose, against poses to opposite sides of it; mean over frames.

    A day's fit sums over frames how well classified points lie on a camera's likelihoods. Where the sum of a frame
    prefers the reference to all other poses, it has no slope there.

    Args:
        points_camera: points at the reference.
        maps: log-likelihood of classes.
        probability: of each point's classes.

    Source: van den Oord et al. 2018, "Representation learning with contrastive predictive coding".
    """
    turns, shifts = torch.randn(2, _BESIDE, 3, generator=generator)
    beside = pose(exp_so3(turns * torch.tensor(_BESIDE_DEG) / DEG), shifts * torch.tensor(_BESIDE_M))
    T = torch.cat([torch.eye(4)[None], beside, inverse(beside)]).to(points_camera)
    uv, ahead = projection.project(transform_points(T[:, None], points_camera).transpose(0, 1))
    size = uv.new_tensor([maps.shape[3], maps.shape[2]])
    found = F.grid_sample(maps, (2 * uv + 1) / size - 1, padding_mode="border", align_corners=False)
    weight = weight * ahead[:, 0]
    fitting = torch.einsum("fckn,fnc,fn->fk", found, probability, weight)
    scores = _EVIDENCE_WORTH * fitting / weight.sum(1, keepdim=True).clamp_min(1e-3)
    return -torch.log_softmax(scores, 1)[:, 0].mean()


@dataclass(frozen=True, eq=False)
class RadarTracks:
    """Tracked clusters of F frames."""

    xyz_m: Float[Tensor, "F M 3"]  # radar frame
    present: Bool[Tensor, "F M"]  # which rows are tracks
    has_elevation: Bool[Tensor, " F"]  # whether the radar measures it; else azimuth and the plane count alone

    def nearest_cost(
        self, flat: Float[Tensor, "*batch F M G"], upwards: Float[Tensor, "*batch F M G"],
        target_present: Bool[Tensor, "F G"], tau: float, clamp: float,
    ) -> Float[Tensor, "*batch F"]:  # fmt: skip
        """Mean over the tracks of the soft minimum of clamped distances; 0 for a frame without tracks or targets.

        Args:
            upwards: signed difference in elevation or height, weighted by the precision of a radar's
                elevation relative to its azimuth.
            tau: width of the soft minimum, in units of the distances.
            clamp: largest distance.
        """
        weight = _ELEVATION_WEIGHT * self.has_elevation.to(upwards.dtype)[:, None, None]
        distance = (flat + (weight * upwards).square() + 1e-8).sqrt()  # a finite slope at 0
        clamped = soft_clamp(distance, clamp).masked_fill(~target_present[:, None], 2 * clamp)
        least = -tau * torch.logsumexp(-clamped / tau, -1)
        return masked_mean(least, self.present) * target_present.any(-1)


def track_detection_cost(
    T_camera_radar: Float[Tensor, "*batch #F 4 4"],
    tracks: RadarTracks,
    centres_rad: Float[Tensor, "F G 2"],
    present: Bool[Tensor, "F G"],
) -> Float[Tensor, "*batch F"]:
    """Distance of tracked clusters to road users' box centres, by azimuth (left) and elevation (up) [deg]."""
    directions_rad = _directions(transform_points(T_camera_radar, tracks.xyz_m))
    off = (directions_rad[..., :, None, :] - centres_rad[:, None]) * DEG
    return tracks.nearest_cost(
        off[..., 0].square(), off[..., 1], present, DETECTION_TAU_DEG, DETECTION_CLAMP_DEG
    )


def track_cluster_cost(
    T_lidar_radar: Float[Tensor, "*batch #F 4 4"],
    tracks: RadarTracks,
    centres: Float[Tensor, "F K 3"],
    present: Bool[Tensor, "F K"],
) -> Float[Tensor, "*batch F"]:
    """Distance of tracked clusters to lidar clusters' centres [m]."""
    off = transform_points(T_lidar_radar, tracks.xyz_m)[..., :, None, :] - centres[:, None]
    flat = off[..., :2].square().sum(-1)
    return tracks.nearest_cost(flat, off[..., 2], present, CLUSTER_TAU_M, CLUSTER_CLAMP_M)


def _directions(points_camera: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """Azimuth to the left and elevation upwards [rad], as `camera_direction_angles`; (0, 0) for the origin."""
    x, y, z = points_camera.unbind(-1)
    h2 = x * x + z * z
    off = h2 > 1e-6
    ahead, h = torch.where(off, z, torch.ones_like(z)), torch.where(off, h2, torch.ones_like(h2)).sqrt()
    return torch.stack([torch.atan2(-x, ahead), torch.atan2(-y, h)], -1) * off[..., None]


def soft_clamp(values: Float[Tensor, "*shape"], limit: float) -> Float[Tensor, "*shape"]:
    """Nearly the value itself if small, with a smooth saturation at `limit`; for values >= 0."""
    return limit * torch.tanh(values / limit)
