"""Rows of table `training` to a batch of tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from pipeline.core.errors import ContractError
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.rig.se3 import from_quaternion
from schemas.columns import POSE_COLUMNS
from schemas.training import TrainingRow

__all__ = ["collate"]

_MAPS = {
    "image": (3,),
    "grid_class": (),
    "grid_seen": (),
    "class_distance": (6,),
    "edge_offset": (4,),
    "sky_depth": (),
}
_ARRAYS = (
    "detection_box_rad", "lidar_xyz_m", "lidar_intensity", "lidar_flags",
    "cluster_xyz_m", "cluster_id", "cluster_centre_m", "edge_xyz_m", "edge_side",
    "drivable_xyz_m", "radar_xyz_m", "radar_residual_mps", "radar_power_db", "radar_motion", "track_xyz_m",
    "radar_drivable",
)  # fmt: skip
# Mask -> how many rows are real, and an array that has all of them.
_MASKS = {
    "detection_valid": ("detection_count", "detection_box_rad"),
    "lidar_valid": ("lidar_count", "lidar_flags"),
    "cluster_point_valid": ("cluster_point_count", "cluster_id"),
    "cluster_valid": ("cluster_count", "cluster_centre_m"),
    "edge_valid": ("edge_count", "edge_side"),
    "drivable_valid": ("drivable_count", "drivable_xyz_m"),
    "radar_valid": ("radar_count", "radar_motion"),
    "track_valid": ("track_count", "track_xyz_m"),
}
_NUMBERS = ("ego_speed_mps", "camera_lag_s", "radar_lag_s", "drivable_area_m2")


def collate(rows: Sequence[TrainingRow]) -> TrainingBatch:
    """Stack rows of one table; raises ContractError if they differ in grid or counts."""
    height, width, step = rows[0].grid_height, rows[0].grid_width, rows[0].grid_step_deg
    if any((r.grid_height, r.grid_width, r.grid_step_deg) != (height, width, step) for r in rows):
        raise ContractError(
            "training", "rows have different grids: run `boresight prepare` for all days again"
        )
    try:
        arrays = {name: np.stack([getattr(r, name) for r in rows]) for name in (*_MAPS, *_ARRAYS)}
    except ValueError as err:
        problem = "rows have different counts of points: run `boresight prepare` for all days again"
        raise ContractError("training", problem) from err
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
        environment=tuple(r.environment for r in rows),
        frame_index=torch.tensor([r.frame_index for r in rows], dtype=torch.int32),
        ground_plane=torch.from_numpy(np.stack([r.ground_plane for r in rows]).astype(np.float32)),
        radar_has_elevation=torch.tensor([r.radar_has_elevation for r in rows]),
        T_camera_lidar=_transforms(rows, "prior_camera_lidar_"),
        T_lidar_radar=_transforms(rows, "prior_lidar_radar_"),
        **tensors,
    )


def _transforms(rows: Sequence[TrainingRow], prefix: str) -> Float[torch.Tensor, "B 4 4"]:
    values = np.array([[getattr(r, prefix + name) for name in POSE_COLUMNS] for r in rows])
    return torch.from_numpy(from_quaternion(values[:, :4], values[:, 4:]).astype(np.float32))
