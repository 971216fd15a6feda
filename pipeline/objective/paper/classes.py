"""Shared code of the paper's losses and triggers: classes, robust distance, points in view; the loop that joins losses.

Source: sections 4.3, 4.4 and 4.5.3, equations 1 and 2. The paper writes T_lidar^camera T_radar^lidar T_camera^radar;
in the house's names that is T_camera_lidar T_lidar_radar T_camera_radar^-1.

Cost of projected points in the frames' cost maps, for many poses at once.

A cost map holds robust distance, sky penalty and other costs of a pixel; between pixels the cost is bilinear. Points
outside the image, or behind the camera, cost the out-of-view penalty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from pipeline.core.errors import ContractError
from pipeline.objective.camera_lidar.projection_loops import camera_parameters, project_points
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import inverse
from schemas.observations import Observation

__all__ = [
    "REFLECTING", "ROAD", "SKY", "FoldedFrames", "camera_at_label_size", "distance_cost", "euler_angles",
    "fold_frames", "frame_costs", "in_range", "labels_of", "loop_loss", "loop_transform", "safely_in_view",
    "thin",
]  # fmt: skip


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


ROAD, SKY = 0, 10  # Cityscapes train ids
_RANGE_M = (2.0, 80.0)
# Paper, section 4.3: "vehicles, pedestrians, signs, poles, buildings, fences, and vegetation"; walls and
# traffic lights go with fences and signs.
REFLECTING = np.array([2, 3, 4, 5, 6, 7, 8, 11, 12, 13, 14, 15, 16, 17, 18], np.uint8)


def labels_of(observation: Observation) -> UInt8[np.ndarray, "H W"]:
    """The label image, Cityscapes train ids."""
    labels = cv2.imdecode(np.frombuffer(observation.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if labels is None:
        raise ContractError("observations", f"labels_png of frame {observation.frame_index} is no image")
    return labels.astype(np.uint8, copy=False)


def camera_at_label_size(observation: Observation, labels: UInt8[np.ndarray, "H W"]) -> Camera:
    """The camera that projects into the frame's label image, whose size wins over rounding."""
    scaled = camera_of(observation).scaled(observation.label_scale)
    K = scaled.K.copy()
    K[:2, 2] -= observation.label_offset_px
    return Camera(scaled.model, K, scaled.D, labels.shape[1], labels.shape[0])


def distance_cost(distance: Float[np.ndarray, "*shape"], scale: float) -> Float[np.ndarray, "*shape"]:
    """Smooth robust distance d^2 / (d^2 + s^2), 0..1; the paper names no function."""
    d2 = distance * distance
    return d2 / (d2 + scale * scale)


def safely_in_view(
    camera: Camera, points_camera: Float[np.ndarray, "N 3"], margin_rad: float
) -> Bool[np.ndarray, " N"]:
    """True for points inside the image by a margin: an angle, at most a quarter of the image's half extent.

    The paper's lidar and radar see less than its camera, so all of their points must fall into the image. If
    a sensor sees more (a 360 deg lidar), only points that stay in view with a prior wrong by the margin must
    do so; otherwise the penalty biases the pose.
    """
    uv, valid = camera.project(points_camera)
    size = np.array([camera.width_px, camera.height_px])
    margin = np.minimum(margin_rad * np.array(camera.focal_px), size / 8)
    return valid & np.all((uv >= margin) & (uv <= size - 1 - margin), axis=1)


def in_range(points: np.ndarray) -> Float[np.ndarray, "M 3"]:
    """Points from 2 m (nearer is the car itself) to the paper's far limit, as float64."""
    distance = np.linalg.norm(points, axis=1)
    return points[(distance > _RANGE_M[0]) & (distance < _RANGE_M[1])].astype(np.float64)


def thin(points: Float[np.ndarray, "N 3"], limit: int) -> Float[np.ndarray, "M 3"]:
    """At most `limit` points, evenly spread over their order."""
    return points if len(points) <= limit else points[np.linspace(0, len(points) - 1, limit).astype(int)]


def loop_transform(
    T_camera_lidar: Float[np.ndarray, "*batch 4 4"],
    T_lidar_radar: Float[np.ndarray, "*batch 4 4"],
    T_camera_radar: Float[np.ndarray, "*batch 4 4"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """The closed loop, identity where the three agree."""
    return T_camera_lidar @ T_lidar_radar @ inverse(T_camera_radar)


def loop_loss(T_loop: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """l1 norm of the loop's Euler angles [rad] and translation [m], added as they are: the paper names no units."""
    return np.asarray(np.abs(euler_angles(T_loop)).sum(-1) + np.abs(T_loop[..., :3, 3]).sum(-1))


def euler_angles(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 3"]:
    """Roll, pitch, yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-pi/2, pi/2]."""
    return np.stack(
        [
            np.arctan2(T[..., 2, 1], T[..., 2, 2]),
            -np.arcsin(np.clip(T[..., 2, 0], -1, 1)),
            np.arctan2(T[..., 1, 0], T[..., 0, 0]),
        ],
        -1,
    )
