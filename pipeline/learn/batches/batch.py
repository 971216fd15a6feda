"""A batch of training frames as tensors: from the loader to networks, losses and augmentation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int8, Int16, Int32, Int64, UInt8

__all__ = ["TrainingBatch"]

Tensor = torch.Tensor


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """B frames; columns of table `training` (see `schemas/training.py` for grid, units and frames).

    Arrays keep their stored types, so that less data is copied to the device. Padded rows hold zeros; the
    masks `*_valid` are true for rows that are not padding.
    """

    grid_step_deg: float
    vehicle: tuple[str, ...]
    day: tuple[str, ...]
    environment: tuple[str, ...]
    frame_index: Int32[Tensor, " B"]
    # camera, on the equirectangular grid of its optical frame
    image: UInt8[Tensor, "B 3 H W"]  # red, green, blue
    grid_class: UInt8[Tensor, "B H W"]  # index into GRID_CLASSES, UNKNOWN_CLASS
    grid_seen: UInt8[Tensor, "B H W"]  # 1 where the image shows the whole cell
    class_distance: UInt8[Tensor, "B 6 H W"]  # 0.1 deg, by DISTANCE_GROUPS
    edge_offset: Int8[Tensor, "B 4 H W"]  # 0.05 deg, by EDGE_LEFT/RIGHT/ABOVE/BELOW, NO_EDGE
    sky_depth: UInt8[Tensor, "B H W"]  # 0.1 deg
    detection_box_rad: Float[Tensor, "B G 4"]  # azimuth left, elevation top, azimuth right, elevation bottom
    detection_valid: Bool[Tensor, "B G"]
    # lidar frame
    lidar_xyz_m: Float[Tensor, "B N 3"]
    lidar_intensity: UInt8[Tensor, "B N"]
    lidar_flags: UInt8[Tensor, "B N"]  # POINT_IS_EDGE | POINT_IS_GROUND
    lidar_valid: Bool[Tensor, "B N"]
    cluster_xyz_m: Float[Tensor, "B C 3"]
    cluster_id: Int16[Tensor, "B C"]
    cluster_point_valid: Bool[Tensor, "B C"]
    cluster_centre_m: Float[Tensor, "B K 3"]
    cluster_valid: Bool[Tensor, "B K"]
    edge_xyz_m: Float[Tensor, "B E 3"]
    edge_side: UInt8[Tensor, "B E"]
    edge_valid: Bool[Tensor, "B E"]
    drivable_xyz_m: Float[Tensor, "B D 3"]
    drivable_valid: Bool[Tensor, "B D"]
    drivable_area_m2: Float[Tensor, " B"]
    ground_plane: Float[Tensor, "B 4"]
    # radar frame
    radar_xyz_m: Float[Tensor, "B R 3"]
    radar_residual_mps: Float[Tensor, "B R"]
    radar_power_db: Float[Tensor, "B R"]
    radar_motion: UInt8[Tensor, "B R"]
    radar_valid: Bool[Tensor, "B R"]
    radar_has_elevation: Bool[Tensor, " B"]
    track_xyz_m: Float[Tensor, "B T 3"]
    track_valid: Bool[Tensor, "B T"]
    radar_drivable: UInt8[Tensor, "B X Y"]  # soft, cells of 1 m: x = r + 1/2, y = c - Y/2 + 1/2
    # the whole
    ego_speed_mps: Float[Tensor, " B"]
    camera_lag_s: Float[Tensor, " B"]
    radar_lag_s: Float[Tensor, " B"]
    T_camera_lidar: Float[Tensor, "B 4 4"]  # the prior
    T_lidar_radar: Float[Tensor, "B 4 4"]  # the prior

    def __len__(self) -> int:
        """Frames of the batch."""
        return int(self.image.shape[0])

    @property
    def T_camera_radar(self) -> Float[Tensor, "B 4 4"]:
        """The prior's, composed."""
        return self.T_camera_lidar @ self.T_lidar_radar

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> TrainingBatch:
        """The same batch on a device."""
        return self._map(lambda t: t.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> TrainingBatch:
        """The batch in page-locked memory, which a GPU reads directly."""
        return self._map(torch.Tensor.pin_memory)

    def __getitem__(self, rows: slice) -> TrainingBatch:
        """Some of the frames."""
        return self.take(torch.arange(len(self), device=self.image.device)[rows])

    def take(self, rows: Int64[Tensor, " K"]) -> TrainingBatch:
        """Frames by number, in any order; `rows` on the batch's device."""
        part = self._map(lambda t: t[rows])
        picked, words = rows.tolist(), ("vehicle", "day", "environment")
        names: dict[str, Any] = {n: tuple(getattr(self, n)[i] for i in picked) for n in words}
        return replace(part, **names)

    def _map(self, function: Callable[[Tensor], Tensor]) -> TrainingBatch:
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        mapped: dict[str, Any] = {n: function(v) for n, v in values.items() if isinstance(v, torch.Tensor)}
        return replace(self, **mapped)
