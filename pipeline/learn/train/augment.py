"""Random wrong guesses, mirrored frames and turned camera views: a network memorises neither a mounting nor a side.

A cloud moved by A and seen at T looks like the cloud seen at T A, so the guesses move instead of the clouds.
Lidar and radar move independently; the three guesses close the loop. Of two frames in a row the second is moved and
turned by the inverses of the first's, so that no mean of a batch can be learnt. A turned view is the same image on a
grid turned by R: poses into the turned camera are R T, and the losses, which keep the unturned maps, get R^-1 T.

Source: paper section 4.5.4 (random rotation and translation of lidar and radar clouds); mirrors and turned views are
new here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.sample.camera_maps import stored_grid
from pipeline.learn.sample.grid import grid_rays
from pipeline.learn.train.settings import AugmentConfig
from pipeline.objective.differentiable.poses import exp_so3, inverse, pose
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT
from schemas.training import NO_EDGE, UNKNOWN_CLASS

__all__ = ["Guess", "mirrored", "random_guess", "turned_view"]

_RAD = torch.pi / 180.0
# Of the camera's frame (x right, y down, z ahead), and of those of lidar and radar (x ahead, y left, z up).
_CAMERA_MIRROR, _MIRROR = torch.tensor([-1.0, 1.0, 1.0, 1.0]), torch.tensor([1.0, -1.0, 1.0, 1.0])
_OTHER_SIDE = torch.tensor([EDGE_RIGHT, EDGE_LEFT, EDGE_ABOVE, EDGE_BELOW])  # by the sides' own numbers
_POINTS = ("lidar_xyz_m", "cluster_centre_m", "edge_xyz_m", "radar_xyz_m", "track_xyz_m", "ego_velocity_mps")


@dataclass(frozen=True, eq=False)
class Guess:
    """Where the network starts, seen from the turned camera, and how that camera is turned."""

    R_turned_camera: Float[Tensor, "B 3 3"]
    T_camera_lidar: Float[Tensor, "B 4 4"]
    T_camera_radar: Float[Tensor, "B 4 4"]
    T_lidar_radar: Float[Tensor, "B 4 4"]

    def unturned(self, T_turned: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 4 4"]:
        """A pose into the turned camera as one into the camera itself."""
        R = self.R_turned_camera.transpose(-1, -2)
        return pose(R, torch.zeros_like(R[..., 0])) @ T_turned


def random_guess(batch: TrainingBatch, config: AugmentConfig, generator: torch.Generator) -> Guess:
    """Guesses about the batch's reference poses; a generator of the CPU gives the same on every device."""
    device = batch.T_camera_lidar.device
    count = (len(batch) + 1) // 2  # of the pairs of frames

    def even(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    def both(T: Float[Tensor, "P 4 4"]) -> Float[Tensor, "B 4 4"]:
        return torch.stack([T, inverse(T)], 1).flatten(0, 1)[: len(batch)].to(device)

    small = torch.rand(count, generator=generator) < config.small_share
    scale = torch.where(small, torch.rand(count, generator=generator) ** 2, torch.ones(count))[:, None]
    turns = [exp_so3(even(count, 3) * scale * config.rotation_deg * _RAD) for _ in range(2)]
    shifts = [even(count, 3) * scale * config.translation_m for _ in range(2)]
    view = exp_so3(even(count, 3) * config.view_deg * _RAD)
    moved_lidar, moved_radar = (both(pose(R, t)) for R, t in zip(turns, shifts, strict=True))
    turned = both(pose(view, torch.zeros(count, 3)))
    T_lidar_radar = inverse(moved_lidar) @ batch.T_lidar_radar @ moved_radar
    T_camera_lidar = turned @ batch.T_camera_lidar @ moved_lidar
    return Guess(turned[:, :3, :3], T_camera_lidar, T_camera_lidar @ T_lidar_radar, T_lidar_radar)


def mirrored(batch: TrainingBatch, rows: Bool[Tensor, " B"]) -> TrainingBatch:
    """The batch with left and right exchanged in some frames: image, clouds, motion and poses together.

    A pose that is wrong by an angle to one side is wrong to the other side in the mirror: what a network learns from
    labels and references has no side. Every sensor's points are mirrored in its own frame, so poses stay rotations.
    """
    camera, other = (torch.diag(v).to(batch.T_camera_lidar) for v in (_CAMERA_MIRROR, _MIRROR))
    left, top, right, bottom = batch.detection_box_rad.unbind(-1)
    offset = batch.edge_offset[:, _OTHER_SIDE].flip(-1)
    sideways = offset[:, :2].where(offset[:, :2] == NO_EDGE, -offset[:, :2])
    found = {name: getattr(batch, name) @ other[:3, :3] for name in _POINTS} | {
        **{name: getattr(batch, name).flip(-1) for name in ("image", "grid_class", "grid_seen")},
        "edge_offset": torch.cat([sideways, offset[:, 2:]], 1),
        "edge_side": _OTHER_SIDE.to(batch.edge_side)[batch.edge_side.long()],
        "detection_box_rad": torch.stack([-right, top, -left, bottom], -1),
        "ground_plane": batch.ground_plane @ other,
        "ego_yaw_rate_radps": -batch.ego_yaw_rate_radps,
        "T_camera_lidar": camera @ batch.T_camera_lidar @ other,
        "T_lidar_radar": other @ batch.T_lidar_radar @ other,
    }
    frames = torch.arange(len(batch), device=rows.device) + len(batch) * rows
    taken: dict[str, Any] = {n: torch.cat([getattr(batch, n), v])[frames] for n, v in found.items()}
    return replace(batch, **taken)


def turned_view(batch: TrainingBatch, R_turned_camera: Float[Tensor, "B 3 3"]) -> TrainingBatch:
    """The batch with image, classes and visibility of a turned camera; other columns stay.

    Cells outside the stored grid are unseen and of unknown class.
    """
    height, width = batch.grid_seen.shape[1:]
    step = batch.grid_step_deg * _RAD
    cells = grid_rays(stored_grid((height, width), batch.grid_step_deg)).astype(np.float32)
    rays = torch.from_numpy(cells).to(R_turned_camera.device)
    # A ray of the turned grid comes from R^T ray of the stored one.
    source = torch.einsum("byx,hwy->bhwx", R_turned_camera, rays)
    azimuth = torch.atan2(-source[..., 0], source[..., 2])
    elevation = torch.atan2(-source[..., 1], torch.hypot(source[..., 0], source[..., 2]))
    u = (width - 1) / 2 - azimuth / step
    v = (height - 1) / 2 - elevation / step
    at = torch.stack([2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1], -1)
    image = _sampled(batch.image.float(), at, "bilinear")
    classes = _sampled(batch.grid_class[:, None].float() + 1, at, "nearest")[
        :, 0
    ]  # 0 is left for "not there"
    seen = _sampled(batch.grid_seen[:, None].float(), at, "bilinear")[:, 0] > 0.999
    label = torch.where((classes > 0) & seen, classes - 1, torch.full_like(classes, UNKNOWN_CLASS))
    return replace(
        batch,
        image=(image * seen[:, None]).round().to(torch.uint8),
        grid_class=label.to(torch.uint8),
        grid_seen=seen.to(torch.uint8),
    )


def _sampled(maps: Tensor, at: Tensor, mode: str) -> Tensor:
    return torch.nn.functional.grid_sample(maps, at, mode=mode, padding_mode="zeros", align_corners=True)
