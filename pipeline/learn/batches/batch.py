"""A batch of training frames as tensors: from the loader to networks, losses and augmentation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int8, Int32, Int64, UInt8
from torch import Tensor

from pipeline.core.errors import ContractError
from pipeline.learn.sample.clouds import padded_rows
from pipeline.learn.sample.rendering import lidar_features, radar_features
from pipeline.rig.se3 import from_quaternion
from schemas.columns import POSE_COLUMNS
from schemas.training import TrainingRow

__all__ = ["TrainingBatch", "collate"]

_MAPS = {"image": (3,), "grid_class": (), "grid_seen": (), "edge_offset": (4,)}
_ARRAYS = (
    "detection_box_rad", "lidar_xyz_m", "cluster_centre_m", "edge_xyz_m", "edge_side", "radar_xyz_m",
    "radar_motion", "track_xyz_m", "ego_velocity_mps",
)  # fmt: skip
# Mask -> how many rows are real, and an array that has all of them.
_MASKS = {
    "detection_valid": ("detection_count", "detection_box_rad"),
    "lidar_valid": ("lidar_count", "lidar_xyz_m"),
    "cluster_valid": ("cluster_count", "cluster_centre_m"),
    "edge_valid": ("edge_count", "edge_side"),
    "radar_valid": ("radar_count", "radar_motion"),
    "track_valid": ("track_count", "track_xyz_m"),
}
_NUMBERS = ("ego_yaw_rate_radps", "camera_lag_s", "radar_lag_s")


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """B frames; columns of table `training` (see `schemas/training.py` for grid, units and frames).

    Arrays keep their stored types, so that less data is copied to the device. Padded rows hold zeros; the
    masks `*_valid` are true for rows that are not padding.
    """

    grid_step_deg: float
    vehicle: tuple[str, ...]
    day: tuple[str, ...]
    frame_index: Int32[Tensor, " B"]
    # camera, on the equirectangular grid of its optical frame
    image: UInt8[Tensor, "B 3 H W"]  # red, green, blue
    grid_class: UInt8[Tensor, "B H W"]  # index into GRID_CLASSES, UNKNOWN_CLASS
    grid_seen: UInt8[Tensor, "B H W"]  # 1 where the image shows the whole cell
    edge_offset: Int8[Tensor, "B 4 H W"]  # 0.05 deg, by EDGE_LEFT/RIGHT/ABOVE/BELOW, NO_EDGE
    detection_box_rad: Float[Tensor, "B G 4"]  # azimuth left, elevation top, azimuth right, elevation bottom
    detection_valid: Bool[Tensor, "B G"]
    # lidar frame
    lidar_xyz_m: Float[Tensor, "B N 3"]
    lidar_features: Float[Tensor, "B N 4"]  # LIDAR_FEATURES
    lidar_valid: Bool[Tensor, "B N"]
    cluster_centre_m: Float[Tensor, "B K 3"]
    cluster_valid: Bool[Tensor, "B K"]
    edge_xyz_m: Float[Tensor, "B E 3"]
    edge_side: UInt8[Tensor, "B E"]
    edge_valid: Bool[Tensor, "B E"]
    ground_plane: Float[Tensor, "B 4"]
    # radar frame
    radar_xyz_m: Float[Tensor, "B R 3"]
    radar_features: Float[Tensor, "B R 3"]  # RADAR_FEATURES
    radar_motion: UInt8[Tensor, "B R"]
    radar_valid: Bool[Tensor, "B R"]
    radar_has_elevation: Bool[Tensor, " B"]
    track_xyz_m: Float[Tensor, "B T 3"]
    track_valid: Bool[Tensor, "B T"]
    # the whole
    ego_velocity_mps: Float[Tensor, "B 3"]  # lidar frame
    ego_yaw_rate_radps: Float[Tensor, " B"]
    camera_lag_s: Float[Tensor, " B"]
    radar_lag_s: Float[Tensor, " B"]
    T_camera_lidar: Float[Tensor, "B 4 4"]  # the reference
    T_lidar_radar: Float[Tensor, "B 4 4"]  # the reference

    def __len__(self) -> int:
        """Frames of the batch."""
        return int(self.image.shape[0])

    @property
    def T_camera_radar(self) -> Float[Tensor, "B 4 4"]:
        """The reference's, composed."""
        return self.T_camera_lidar @ self.T_lidar_radar

    def to(self, device: torch.device | str) -> TrainingBatch:
        """The same batch on a device."""
        return self._map(lambda t: t.to(device))

    def __getitem__(self, rows: slice) -> TrainingBatch:
        """Some of the frames."""
        return self.take(torch.arange(len(self), device=self.image.device)[rows])

    def take(self, rows: Int64[Tensor, " K"]) -> TrainingBatch:
        """Frames by number, in any order; `rows` on the batch's device."""
        vehicle, day = (tuple(names[i] for i in rows.tolist()) for names in (self.vehicle, self.day))
        return replace(self._map(lambda t: t[rows]), vehicle=vehicle, day=day)

    def _map(self, function: Callable[[Tensor], Tensor]) -> TrainingBatch:
        mapped: dict[str, Any] = {n: function(v) for n, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **mapped)


def collate(rows: Sequence[TrainingRow]) -> TrainingBatch:
    """Stack rows of one table; raises ContractError if they differ in grid or counts."""
    sizes = {
        (r.grid_height, r.grid_width, r.grid_step_deg, len(r.lidar_xyz_m), len(r.edge_xyz_m)) for r in rows
    }
    if len(sizes) > 1:
        problem = "rows have different grids or counts of points: run `boresight prepare` for all days again"
        raise ContractError("training", problem)
    [(height, width, step, lidar, _)] = sizes
    arrays = {name: np.stack([getattr(r, name) for r in rows]) for name in (*_MAPS, *_ARRAYS)}
    arrays["lidar_features"] = np.stack([padded_rows(lidar_features(r), lidar) for r in rows])
    arrays["radar_features"] = np.stack([padded_rows(radar_features(r), len(r.radar_xyz_m)) for r in rows])
    tensors = {name: torch.from_numpy(values) for name, values in arrays.items()}
    tensors |= {n: tensors[n].reshape(len(rows), *planes, height, width) for n, planes in _MAPS.items()}
    for mask, (count, counted) in _MASKS.items():
        real = torch.tensor([getattr(r, count) for r in rows])
        tensors[mask] = torch.arange(arrays[counted].shape[1]) < real[:, None]
    for name in _NUMBERS:
        tensors[name] = torch.tensor([getattr(r, name) for r in rows], dtype=torch.float32)
    return TrainingBatch(
        grid_step_deg=step,
        vehicle=tuple(r.vehicle for r in rows),
        day=tuple(r.day for r in rows),
        frame_index=torch.tensor([r.frame_index for r in rows], dtype=torch.int32),
        ground_plane=torch.from_numpy(np.stack([r.ground_plane for r in rows]).astype(np.float32)),
        radar_has_elevation=torch.tensor([r.radar_has_elevation for r in rows]),
        T_camera_lidar=_transforms(rows, "reference_camera_lidar_"),
        T_lidar_radar=_transforms(rows, "reference_lidar_radar_"),
        **tensors,
    )


def _transforms(rows: Sequence[TrainingRow], prefix: str) -> Float[Tensor, "B 4 4"]:
    values = np.array([[getattr(r, prefix + name) for name in POSE_COLUMNS] for r in rows])
    return torch.from_numpy(from_quaternion(values[:, :4], values[:, 4:]).astype(np.float32))
