"""The paper's three pairwise losses in torch: the compiled losses, written so that autograd works.

Points, maps, weights and limits come from `camera_lidar`, `camera_radar` and `lidar_radar` of
`pipeline.objective`. Poses are `*batch #F 4 4`: one per frame, or a stack of poses for all frames (`T[:,
None]`).

Source: paper section 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.objective.differentiable.projection import (
    CameraProjection,
    bilinear,
    camera_projection,
    inverse,
    masked_mean,
    transform_points,
)
from pipeline.objective.paper import camera_radar, lidar_radar
from pipeline.objective.paper.camera_radar import CameraRadarLoss
from pipeline.objective.paper.classes import FoldedFrames
from pipeline.objective.paper.lidar_radar import LidarRadarLoss

__all__ = [
    "CameraRadarTensors", "FoldedTensors", "LidarRadarTensors", "camera_radar_tensors", "distance_cost",
    "folded_tensors", "lidar_radar_tensors", "padded",
]  # fmt: skip


def distance_cost(squared: Float[Tensor, "*shape"], scale: float | Tensor) -> Float[Tensor, "*shape"]:
    """d^2 / (d^2 + s^2) of squared distances, as `pipeline.objective.paper.classes.distance_cost`."""
    return squared / (squared + scale * scale)


@dataclass(frozen=True, eq=False)
class FoldedTensors:
    """Points and cost maps of F frames, as `FoldedFrames` holds them."""

    points: Float[Tensor, "F N 3"]
    present: Bool[Tensor, "F N"]
    maps: Float[Tensor, "F H W"]
    projection: CameraProjection
    penalty: float

    def frame_losses(self, T_camera_points: Float[Tensor, "*batch #F 4 4"]) -> Float[Tensor, "*batch F"]:
        """Mean cost of each frame's points."""
        uv, valid = self.projection.project(transform_points(T_camera_points, self.points))
        value = bilinear(self.maps, uv, valid, -1.0)
        return masked_mean(torch.where(value < 0, self.penalty, value), self.present)


@dataclass(frozen=True, eq=False)
class CameraRadarTensors:
    """Tracks, box centres, and detections with their sky maps."""

    tracks: Float[Tensor, "F M 3"]
    track_present: Bool[Tensor, "F M"]
    centres_px: Float[Tensor, "F B 2"]
    informative: Bool[Tensor, " F"]
    scale_px: float
    detections: FoldedTensors

    def frame_losses(self, T_camera_radar: Float[Tensor, "*batch #F 4 4"]) -> Float[Tensor, "*batch F"]:
        """Loss of each frame; 0 where it has no track or no road user."""
        uv, valid = self.detections.projection.project(transform_points(T_camera_radar, self.tracks))
        squared = (uv[..., :, None, :] - self.centres_px[:, None]).square().sum(-1).amin(-1)
        cost = torch.where(valid, distance_cost(squared, self.scale_px), torch.ones_like(squared))
        total = masked_mean(cost, self.track_present) + self.detections.frame_losses(T_camera_radar)
        return total * self.informative


@dataclass(frozen=True, eq=False)
class LidarRadarTensors:
    """Drivable cells and maps, tracks and cluster centres."""

    drivable: Float[Tensor, "F N 3"]
    drivable_present: Bool[Tensor, "F N"]
    lidar_area_m2: Float[Tensor, " F"]
    radar_maps: Float[Tensor, "F ahead across"]
    radar_area_m2: Float[Tensor, " F"]
    tracks: Float[Tensor, "F M 3"]
    track_present: Bool[Tensor, "F M"]
    centres: Float[Tensor, "F K 3"]
    centre_present: Bool[Tensor, "F K"]
    flat: Bool[Tensor, " F"]

    def frame_losses(self, T_lidar_radar: Float[Tensor, "*batch #F 4 4"]) -> Float[Tensor, "*batch F"]:
        """Loss of each frame."""
        has_areas = (self.radar_area_m2 > 0) & (self.lidar_area_m2 > 0)
        has_tracks = self.track_present.any(-1) & self.centre_present.any(-1)
        nearest = masked_mean(self._nearest_costs(T_lidar_radar), self.track_present)
        return (1 - self.drivable_iou(T_lidar_radar)) * has_areas + nearest * has_tracks

    def drivable_iou(self, T_lidar_radar: Float[Tensor, "*batch #F 4 4"]) -> Float[Tensor, "*batch F"]:
        """Smooth IoU of the two drivable areas, 0..1; 0 where a frame lacks one of them."""
        seen = transform_points(inverse(T_lidar_radar), self.drivable)
        row = seen[..., 0] / lidar_radar.CELL_M - 0.5
        column = seen[..., 1] / lidar_radar.CELL_M - 0.5 + self.radar_maps.shape[2] // 2
        known = torch.ones_like(row, dtype=torch.bool)
        inside = bilinear(self.radar_maps, torch.stack([column, row], -1), known, 0.0)
        overlap = masked_mean(inside, self.drivable_present) * self.lidar_area_m2
        return overlap / (self.lidar_area_m2 + self.radar_area_m2 - overlap).clamp_min(1e-9)

    def _nearest_costs(self, T_lidar_radar: Tensor) -> Tensor:
        delta = transform_points(T_lidar_radar, self.tracks)[..., :, None, :] - self.centres[:, None]
        height = torch.where(self.flat[:, None, None], torch.zeros_like(delta[..., 2]), delta[..., 2])
        squared = delta[..., :2].square().sum(-1) + height.square()
        squared = squared.masked_fill(~self.centre_present[:, None], 1e12)
        return distance_cost(squared.amin(-1), lidar_radar.SCALE_M)


def camera_radar_tensors(loss: CameraRadarLoss, dtype: torch.dtype = torch.float32) -> CameraRadarTensors:
    """The prepared camera-radar loss as tensors."""
    frames = range(loss.detections.frames)
    return CameraRadarTensors(
        *padded([loss.tracks_radar[loss.track_frame == f] for f in frames], dtype),
        torch.tensor(loss.centres_px, dtype=dtype),
        torch.tensor(loss.informative),
        camera_radar.SCALE_RAD * loss.detections.cameras[0].focal_px[0],  # the day's one camera, as there
        folded_tensors(loss.detections, dtype),
    )


def lidar_radar_tensors(loss: LidarRadarLoss, dtype: torch.dtype = torch.float32) -> LidarRadarTensors:
    """The prepared lidar-radar loss as tensors."""
    return LidarRadarTensors(
        *padded(np.split(loss.drivable_lidar, loss.drivable_first[1:-1]), dtype),
        torch.tensor(loss.lidar_area_m2, dtype=dtype),
        torch.tensor(loss.radar_maps, dtype=dtype),
        torch.tensor(loss.radar_area_m2, dtype=dtype),
        *padded(np.split(loss.tracks_radar, loss.track_first[1:-1]), dtype),
        *padded(np.split(loss.centres_lidar, loss.centre_first[1:-1]), dtype),
        torch.tensor(loss.flat),
    )


def padded(arrays: Sequence[np.ndarray], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Points of frames, stacked and padded with zeros, and which of them are valid."""
    longest = max([1, *(len(a) for a in arrays)])
    points = np.zeros((len(arrays), longest, 3))
    present = np.zeros((len(arrays), longest), bool)
    for f, a in enumerate(arrays):
        points[f, : len(a)], present[f, : len(a)] = a, True
    return torch.tensor(points, dtype=dtype), torch.tensor(present)


def folded_tensors(frames: FoldedFrames, dtype: torch.dtype = torch.float32) -> FoldedTensors:
    """Points and maps as tensors; ValueError if the cameras differ in size or kind of model."""
    sizes = {costs.shape for costs in frames.maps}
    if len(sizes) != 1:
        raise ValueError(f"the maps of a batch must have one size, not {sorted(sizes)}")
    return FoldedTensors(
        *padded([xyz.T for xyz in frames.xyz_m], dtype),
        torch.from_numpy(np.stack(frames.maps)),
        camera_projection(frames.cameras, dtype),
        frames.penalty,
    )
