"""Cost of projected points in the frames' cost maps, for many poses at once.

A cost map holds robust distance, sky penalty and other costs of a pixel; between pixels the cost is bilinear. Points
outside the image, or behind the camera, cost the out-of-view penalty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.objective.camera_lidar.projection_loops import camera_parameters, project_points
from pipeline.rig.cameras import Camera

__all__ = ["FoldedFrames", "fold_frames", "frame_costs"]


@dataclass(frozen=True, eq=False)
class FoldedFrames:
    """Points of several frames, their cost maps and cameras."""

    xyz_m: tuple[Float32[np.ndarray, "3 _"], ...]
    maps: tuple[Float32[np.ndarray, "_ _"], ...]
    cameras: tuple[Camera, ...]
    penalty: float

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.maps)

    @cached_property
    def camera_parameters(self) -> list[Float32[np.ndarray, " 18"]]:
        """The cameras for compiled loops."""
        return [camera_parameters(camera) for camera in self.cameras]

    @property
    def counts(self) -> Int64[np.ndarray, " F"]:
        """Points per frame."""
        return np.array([xyz.shape[1] for xyz in self.xyz_m], np.int64)


def fold_frames(
    points: Sequence[Float[np.ndarray, "_ 3"]],
    costs: Sequence[Float[np.ndarray, "_ _"]],
    cameras: Sequence[Camera],
    penalty: float,
) -> FoldedFrames:  # fmt: skip
    """Lay out frames for `frame_costs`: points in the child frame [m], cost maps >= 0, scaled cameras.

    `penalty` is the cost of a point out of view or behind the camera.
    """
    for cost, camera in zip(costs, cameras, strict=True):
        if cost.shape != (camera.height_px, camera.width_px):
            raise ValueError(f"map {cost.shape} does not fit camera {camera.height_px} x {camera.width_px}")
    return FoldedFrames(
        tuple(p.T.astype(np.float32, order="C") for p in points),
        tuple(cost.astype(np.float32) for cost in costs),
        tuple(cameras),
        penalty,
    )


def frame_costs(maps: FoldedFrames, T_camera_points: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
    """Sum of the costs of each frame's points at each pose."""
    out = np.zeros((len(T_camera_points), maps.frames))
    poses = np.ascontiguousarray(T_camera_points[:, :3, :], dtype=np.float32).reshape(-1, 12)
    for f, (xyz, costs, camera) in enumerate(zip(maps.xyz_m, maps.maps, maps.camera_parameters, strict=True)):
        u, v = np.empty((2, len(poses), xyz.shape[1]), np.float32)
        if not u.size:
            continue
        for pose, u_px, v_px in zip(poses, u, v, strict=True):
            project_points(camera, xyz, 0, len(u_px), pose, np.float32(1.0), u_px, v_px)
        inside = (u >= 0) & (v >= 0) & (u <= costs.shape[1] - 1) & (v <= costs.shape[0] - 1)
        found = cv2.remap(costs, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[:, f] = np.where(inside, found, np.float32(maps.penalty)).sum(1)
    return out
