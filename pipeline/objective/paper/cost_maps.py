"""Cost of projected points in folded cost maps, for many poses at once.

A frame's cost map already holds robust distance, sky penalty and whatever else a pixel can say ("folded"), as
one byte per pixel; the four bytes that bilinear interpolation needs lie in one 32-bit word ("quad"), so a
point costs one gather. Points outside the image, or behind the camera, cost the out-of-view penalty.

Two projections: pinhole, and `u = cx + fx k(1 - c) x / |p|` with `c = z / |p|` and a polynomial `k`, which
covers f-theta and Kannala-Brandt as well as radial distortion. Tangential distortion is moved into the map
(`fold_map`).

Order of loops: frame, tile of points, pose, point. A tile stays in the L1 cache while all poses pass over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8, UInt32

from pipeline.geometry.cameras import Camera
from pipeline.objective.paper.cost_map_loops import pinhole_costs, polynomial_costs

__all__ = [
    "FoldedFrames",
    "fold_frames",
    "fold_map",
    "frame_costs",
    "pack_quads",
    "without_tangential",
]

_DEGREE = 8  # fit error below 1e-3 px over 116 deg of view
_f4 = np.float32


@dataclass(frozen=True, eq=False)
class FoldedFrames:
    """Points and folded maps of several frames, laid out for the kernel (structure of arrays, frame after frame)."""

    x_m: Float32[np.ndarray, " N"]
    y_m: Float32[np.ndarray, " N"]
    z_m: Float32[np.ndarray, " N"]
    first: Int64[np.ndarray, " F1"]  # points of frame f: first[f]..first[f + 1]
    quads: UInt32[np.ndarray, " Q"]
    map_first: Int64[np.ndarray, " F"]
    size_px: Int32[np.ndarray, "F 2"]  # width, height
    camera: Float32[
        np.ndarray, "F 15"
    ]  # fx fy cx cy, smallest c, byte scale, then k's coefficients by power of (1 - c)
    is_polynomial: bool
    penalty: float

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.map_first)

    @property
    def counts(self) -> Int64[np.ndarray, " F"]:
        """Points per frame."""
        return np.diff(self.first)


def pack_quads(bytes_map: UInt8[np.ndarray, "H W"]) -> UInt32[np.ndarray, "H W"]:
    """Each pixel's byte with those of its right, lower and lower right neighbour (0 beyond the border: no weight)."""
    q = bytes_map.astype(np.uint32)
    q[:, :-1] |= bytes_map[:, 1:].astype(np.uint32) << 8
    q[:-1] |= bytes_map[1:].astype(np.uint32) << 16
    q[:-1, :-1] |= bytes_map[1:, 1:].astype(np.uint32) << 24
    return q


def fold_map(cost: Float[np.ndarray, "H W"], camera: Camera, penalty: float) -> Float32[np.ndarray, "H W"]:
    """The cost map as the kernel's camera sees it: tangential distortion, where there is any, moves the pixels."""
    cost = cost.astype(np.float32)
    radial = without_tangential(camera)
    if radial is camera:
        return cost
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    uv, valid = camera.project(np.nan_to_num(radial.unproject(np.stack([u, v], -1).astype(np.float64))))
    uv = np.where(valid[..., None], uv, -10.0).astype(np.float32)
    return cv2.remap(
        cost, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=penalty
    )


def fold_frames(
    points: Sequence[Float[np.ndarray, "_ 3"]],
    costs: Sequence[Float[np.ndarray, "_ _"]],
    cameras: Sequence[Camera],
    penalty: float,
) -> FoldedFrames:  # fmt: skip
    """Lay out frames for the kernel.

    Args:
        points: points of each frame, in the child frame of the poses that come later [m].
        costs: cost map of each frame, >= 0, at the size of its camera.
        cameras: camera of each frame, scaled to the map. All of one model.
        penalty: cost of a point out of view or behind the camera.
    """
    is_polynomial = any(c.model == "equidistant" or c.D.any() for c in cameras)
    maps, parameters = [], []
    for cost, camera in zip(costs, cameras, strict=True):
        if cost.shape != (camera.height_px, camera.width_px):
            raise ValueError(f"map {cost.shape} does not fit camera {camera.height_px} x {camera.width_px}")
        folded = fold_map(cost, camera, penalty)
        scale = max(float(folded.max()), 1e-6) / 255
        maps.append(pack_quads(np.round(folded / scale).astype(np.uint8)).ravel())
        coefficients, c_min = (
            _polynomial(without_tangential(camera)) if is_polynomial else (np.zeros(_DEGREE + 1), 0.0)
        )
        parameters.append([*camera.focal_px, *camera.centre_px, c_min, scale, *coefficients])
    stacked = (
        np.concatenate([np.asarray(p, np.float32).reshape(-1, 3) for p in points])
        if points
        else np.zeros((0, 3), _f4)
    )
    return FoldedFrames(
        x_m=np.ascontiguousarray(stacked[:, 0]),
        y_m=np.ascontiguousarray(stacked[:, 1]),
        z_m=np.ascontiguousarray(stacked[:, 2]),
        first=np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64),
        quads=np.concatenate(maps) if maps else np.zeros(0, np.uint32),
        map_first=np.concatenate([[0], np.cumsum([m.size for m in maps])])[: len(maps)].astype(np.int64),
        size_px=np.array([[c.width_px, c.height_px] for c in cameras], np.int32).reshape(-1, 2),
        camera=np.array(parameters, np.float32).reshape(-1, 7 + _DEGREE),
        is_polynomial=is_polynomial,
        penalty=penalty,
    )


def frame_costs(
    frames: FoldedFrames, T_camera_points: Float[np.ndarray, "P 4 4"]
) -> Float[np.ndarray, "P F"]:
    """Sum of the costs of each frame's points at each pose."""
    out = np.zeros((len(T_camera_points), frames.frames))
    poses = np.ascontiguousarray(T_camera_points[:, :3, :], dtype=np.float32).reshape(-1, 12)
    kernel = polynomial_costs if frames.is_polynomial else pinhole_costs
    kernel(
        poses, frames.x_m, frames.y_m, frames.z_m, frames.first, frames.quads, frames.map_first, frames.size_px,
        frames.camera, _f4(frames.penalty), out,
    )  # fmt: skip
    return out


def without_tangential(camera: Camera) -> Camera:
    """The camera that folded maps belong to."""
    if camera.model == "equidistant" or len(camera.D) < 4 or not np.any(camera.D[2:4]):
        return camera
    D = camera.D.astype(np.float64).copy()
    D[2:4] = 0.0
    return Camera(camera.model, camera.K, D, camera.width_px, camera.height_px)


def _polynomial(camera: Camera) -> tuple[np.ndarray, float]:
    """Coefficients of k by powers of 1 - cos(angle), and the smallest cosine that the image can show."""
    corners = np.array([[u, v] for u in (0.0, camera.width_px) for v in (0.0, camera.height_px)])
    rays = camera.unproject(corners)
    reach = float(np.arccos(np.nanmin(rays[:, 2]))) if np.isfinite(rays).all() else camera.max_angle_rad
    theta = np.linspace(1e-4, min(1.05 * reach, camera.max_angle_rad), 1500)
    rays = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], -1)
    k = (camera.project(100 * rays)[0][:, 0] - camera.K[0, 2]) / camera.K[0, 0] / np.sin(theta)
    fit = np.polynomial.Polynomial.fit(1 - np.cos(theta), k, _DEGREE).convert()
    coefficients = np.zeros(_DEGREE + 1)
    coefficients[: len(fit.coef)] = fit.coef
    return coefficients, float(np.cos(theta[-1]))
