"""Training loss of a batch: terms of the three pairs and the loop, as in the estimator's objective.

Angles in degrees, translations in metres, per-frame means over valid rows. No term uses a true transform: the
reference is what `joint` found on the day, or the prior.

Source: paper section 4.4 (SSL minimises L_P + L_G); edges, static points and the prior's term are new here.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.train.settings import PAIRS_OF, LossConfig
from pipeline.objective.differentiable.projection import (
    GridProjection,
    exp_so3,
    inverse,
    loop_loss,
    nearest_pixel,
    transform_points,
)
from pipeline.objective.differentiable.static import (
    StaticFrames,
    elevation_limits,
    static_cost,
    tells_elevation,
)
from pipeline.objective.differentiable.terms import (
    DEG,
    GridMaps,
    RadarTracks,
    edge_cost,
    track_cluster_cost,
    track_detection_cost,
)

__all__ = ["FrameObjective", "at_lag", "twist_between", "weighted"]

_MARGIN_DEG = 3.0  # how wrong the reference may be, where points must lie in view
_LOOP_METRE = 5.0  # 0.2 m counts as a degree, by which it moves what is 11 m away
_PRIOR_ROUND_DEG = 0.05  # below this the absolute value is rounded off


class FrameObjective:
    """The objective of B frames, ready for any poses, on the batch's device."""

    def __init__(self, batch: TrainingBatch) -> None:
        self.batch, box = batch, batch.detection_box_rad
        step_rad = batch.grid_step_deg / DEG
        height, width = batch.grid_seen.shape[1:]
        projection = GridProjection(-(width - 1) / 2 * step_rad, -(height - 1) / 2 * step_rad, step_rad)
        self.maps = GridMaps(batch.edge_offset, batch.grid_seen.bool(), projection)
        in_view = _surely_in_view(self.maps, batch.T_camera_lidar, batch.edge_xyz_m)
        self.edge_in_view = batch.edge_valid & in_view
        self.centres_rad = torch.stack([(box[..., 0] + box[..., 2]) / 2, (box[..., 1] + box[..., 3]) / 2], -1)
        self.tracks = RadarTracks(batch.track_xyz_m, batch.track_valid, batch.radar_has_elevation)
        limits = elevation_limits(batch.lidar_xyz_m, batch.lidar_valid)
        T_lidar_radar = batch.T_lidar_radar.to(batch.radar_xyz_m.dtype)
        self.radar_tells_elevation = tells_elevation(
            T_lidar_radar, batch.radar_xyz_m, batch.radar_has_elevation, limits
        )

    def terms(
        self, T_camera_lidar: Float[Tensor, "*batch B 4 4"], T_camera_radar: Float[Tensor, "*batch B 4 4"],
        T_lidar_radar: Float[Tensor, "*batch B 4 4"], pairs: tuple[str, ...] = PAIRS_OF["joint"],
    ) -> dict[str, Float[Tensor, "*batch B"]]:  # fmt: skip
        """Every term of the pairs (`joint`: the loop) and frames, unweighted: LossConfig's names, prior by pair."""
        found, b = dict[str, Tensor](), self.batch
        if "camera_lidar" in pairs:
            edge, side = at_lag(b, b.edge_xyz_m, b.camera_lag_s), b.edge_side.long()
            found["edges"] = edge_cost(self.maps, T_camera_lidar, edge, side, self.edge_in_view)
        if "camera_radar" in pairs:
            seen = self.centres_rad, b.detection_valid
            found["tracks_camera"] = track_detection_cost(T_camera_radar, self.tracks, *seen)
        if "lidar_radar" in pairs:
            lidar, still = at_lag(b, b.lidar_xyz_m, b.radar_lag_s), b.radar_valid & (b.radar_motion == 0)
            frames = StaticFrames(
                b.radar_xyz_m, still, lidar, b.lidar_valid, b.ground_plane, self.radar_tells_elevation
            )
            found["static"] = static_cost(T_lidar_radar, frames)
            found["tracks_lidar"] = track_cluster_cost(
                T_lidar_radar, self.tracks, b.cluster_centre_m, b.cluster_valid
            )
        if "joint" in pairs:
            found["loop"] = loop_loss(
                T_camera_lidar, T_lidar_radar, T_camera_radar, angle_unit=DEG, metre_unit=_LOOP_METRE
            )
        poses = {
            "camera_lidar": (T_camera_lidar, b.T_camera_lidar),
            "camera_radar": (T_camera_radar, b.T_camera_radar),
            "lidar_radar": (T_lidar_radar, b.T_lidar_radar),
        }
        return found | {f"prior_{pair}": _from_prior(*poses[pair]) for pair in pairs if pair in poses}


def _from_prior(
    T: Float[Tensor, "*batch 4 4"], T_prior: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch"]:
    """Distance of a pose to the reference: absolute angles [deg] and shifts (a metre as in the loop), smooth at 0.

    Absolute values, not squares: over a fleet, the references' errors cancel in the median, and the bias of another
    term moves no axis as long as its gradient is smaller.
    """
    twist = twist_between(T, T_prior.to(T.dtype))
    scaled = torch.cat([twist[..., :3] * DEG, twist[..., 3:] * _LOOP_METRE], -1)
    return (torch.sqrt(scaled.square() + _PRIOR_ROUND_DEG**2) - _PRIOR_ROUND_DEG).sum(-1)


def weighted(terms: dict[str, Float[Tensor, "*batch"]], weights: LossConfig) -> Float[Tensor, "*batch"]:
    """Sum of the terms that have a weight."""
    of_term = {name: getattr(weights, "prior" if name.startswith("prior_") else name) for name in terms}
    return torch.stack([w * terms[name] for name, w in of_term.items() if w > 0]).sum(0)


def at_lag(batch: TrainingBatch, points: Float[Tensor, "B N 3"], lag_s: Float[Tensor, " B"]) -> Tensor:
    """Static points in the lidar frame `lag_s` later, when another sensor measures: the car has moved and turned."""
    moved = points - (batch.ego_velocity_mps * lag_s[:, None])[:, None]
    turn = torch.zeros_like(batch.ego_velocity_mps)
    turn[:, 2] = -batch.ego_yaw_rate_radps * lag_s
    return moved @ exp_so3(turn).transpose(1, 2)


def _surely_in_view(maps: GridMaps, T: Tensor, points: Tensor) -> Tensor:
    """Points that the camera sees at this pose, and still sees when it is turned by the margin to any side."""
    uv, valid = maps.projection.project(transform_points(T.to(points.dtype), points))
    margin = _MARGIN_DEG / DEG / maps.projection.step_rad
    frame = torch.arange(len(points), device=points.device)[:, None]
    out = valid
    for du, dv in ((margin, 0.0), (-margin, 0.0), (0.0, margin), (0.0, -margin)):
        row, column, inside = nearest_pixel(maps.size, uv + uv.new_tensor([du, dv]), valid)
        out = out & inside & maps.seen[frame, row, column]
    return out


def twist_between(
    T_a: Float[Tensor, "*batch 4 4"], T_b: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """Rotation vector [rad] and translation [m] of T_a T_b^-1, for angles well below pi."""
    delta = T_a @ inverse(T_b)
    R = delta[..., :3, :3]
    skew = (R - R.transpose(-1, -2))[..., [2, 0, 1], [1, 2, 0]] / 2
    sine = skew.norm(dim=-1, keepdim=True)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    small = sine < 1e-6
    scale = torch.where(small, torch.ones_like(sine), torch.atan2(sine, cosine) / sine.clamp_min(1e-6))
    return torch.cat([scale * skew, delta[..., :3, 3]], -1)
