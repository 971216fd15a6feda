"""Points of the camera-lidar terms: gathered from observations, in or near the camera's view, sorted into kinds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.cameras import Camera
from schemas.observations import Observation

__all__ = [
    "CLASSES",
    "EDGE_KINDS",
    "Points",
    "gather_classes",
    "gather_edges",
    "gather_markings",
    "is_near_view",
    "view_bounds",
]

# Markings brighter than this stand out of their ring (lane paint, patches) [robust sd].
_MARKING_Z = 2.5
# Edges that match alike: direction, height above the road [m], and size of the object (thirds of the day's
# edges). Low and compact things (poles, cars) have boundaries in the labels, tall and large ones (plants,
# walls) mostly not.
_HEIGHTS_M = (1.0, 2.0)
_SIZE_QUANTILES = (1 / 3, 2 / 3)
EDGE_KINDS = 4 * (len(_HEIGHTS_M) + 1) * (len(_SIZE_QUANTILES) + 1)
# Classes of the mutual information: height above the road and range [m].
_CLASS_HEIGHTS_M = (0.25, 1.0, 2.5, 5.0)
_CLASS_RANGES_M = (12.0, 25.0)
CLASSES = (len(_CLASS_HEIGHTS_M) + 1) * (len(_CLASS_RANGES_M) + 1)
_CLASS_STRIDE = 8  # of the sampled cloud: neighbours are redundant


@dataclass(frozen=True, eq=False)
class Points:
    """Points of F frames, one after the other: frame f has rows start[f]:start[f+1]; lidar frame.

    Frame f uses the maps of row image[f], so that maps need not be copied for a selection of frames.

    `exposure_s` is the time of a point's image row after the middle row, if points were moved to that time
    (`rolling_shutter.exposed`).
    """

    xyz_m: np.ndarray
    start: np.ndarray
    side: np.ndarray
    kind: np.ndarray
    gap_rad: np.ndarray
    exposure_s: np.ndarray
    image: np.ndarray

    def chosen(self, keep: np.ndarray) -> Points:
        """The points of a mask."""
        counts = np.concatenate([[0], np.cumsum(keep)])
        return Points(
            np.ascontiguousarray(self.xyz_m[keep]),
            counts[self.start],
            self.side[keep],
            self.kind[keep],
            self.gap_rad[keep],
            self.exposure_s[keep],
            self.image,
        )

    def of_frames(self, frames: np.ndarray) -> Points:
        """The points of some frames, in the order given."""
        rows = [np.arange(self.start[f], self.start[f + 1]) for f in frames]
        start = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
        index = np.concatenate(rows) if rows else np.empty(0, np.int64)
        return Points(
            np.ascontiguousarray(self.xyz_m[index]),
            start,
            self.side[index],
            self.kind[index],
            self.gap_rad[index],
            self.exposure_s[index],
            self.image[frames],
        )


def gather_edges(
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    camera: Camera,
    reach_rad: float,
) -> Points:
    """Depth jumps with their direction and kind."""
    kinds = _kinds(observations)
    columns = [
        (o.lidar_edge_xyz_m, o.lidar_edge_side, k, o.lidar_edge_gap_rad)
        for o, k in zip(observations, kinds, strict=True)
    ]
    return _gather(columns, T_camera_lidar, camera, reach_rad)


def gather_markings(
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    camera: Camera,
    reach_rad: float,
) -> Points:
    """Ground points with a higher reflectivity than the road."""
    bright = [o.marking_xyz_m[o.marking_z > _MARKING_Z] for o in observations]
    plain = [np.zeros(len(b), np.uint8) for b in bright]
    return _gather(list(zip(bright, plain, plain, plain, strict=True)), T_camera_lidar, camera, reach_rad)


def gather_classes(
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    camera: Camera,
    reach_rad: float,
) -> Points:
    """The sampled cloud with its class of height and range."""
    return _gather([_height_classes(o) for o in observations], T_camera_lidar, camera, reach_rad)


def view_bounds(camera: Camera) -> Float[np.ndarray, " 4"]:
    """Smallest and largest azimuth, smallest and largest elevation [rad] along the image's border."""
    border = np.array(
        [
            [u, v]
            for u in (0.0, camera.width_px / 2, camera.width_px)
            for v in (0.0, camera.height_px / 2, camera.height_px)
        ]
    )
    rays = camera.unproject(border)
    rays = rays[np.isfinite(rays).all(1)]
    azimuth = np.arctan2(rays[:, 0], rays[:, 2])
    elevation = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    return np.array([azimuth.min(), azimuth.max(), elevation.min(), elevation.max()])


def is_near_view(
    xyz_m: np.ndarray,
    T_camera_lidar: Float[np.ndarray, "4 4"],
    bounds: Float[np.ndarray, " 4"],
    reach_rad: float,
) -> Bool[np.ndarray, " N"]:
    """True for points [N, 3] within `reach_rad` of the view bounds."""
    q = xyz_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    a, e = np.arctan2(q[:, 0], q[:, 2]), np.arctan2(q[:, 1], np.hypot(q[:, 0], q[:, 2]))
    inside = (a > bounds[0] - reach_rad) & (a < bounds[1] + reach_rad)
    return inside & (e > bounds[2] - reach_rad) & (e < bounds[3] + reach_rad)


def _kinds(observations: Sequence[Observation]) -> list[np.ndarray]:
    """Kind of each edge: direction, height and size class."""
    sizes = np.concatenate([o.lidar_edge_points for o in observations])
    limits = np.quantile(sizes, _SIZE_QUANTILES) if len(sizes) else np.zeros(len(_SIZE_QUANTILES))
    out = []
    for o in observations:
        if o.ground_plane is None:  # the middle class is the least informative
            height = np.full(len(o.lidar_edge_side), np.mean(_HEIGHTS_M))
        else:
            height = o.lidar_edge_xyz_m @ o.ground_plane[:3] + o.ground_plane[3]
        class_ = np.digitize(height, _HEIGHTS_M) * 3 + np.digitize(o.lidar_edge_points, limits, right=True)
        out.append((o.lidar_edge_side * 9 + class_).astype(np.uint8))
    return out


def _height_classes(o: Observation) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Every eighth point of the sampled cloud with its class; none if the road was not found."""
    xyz = o.lidar_map_xyz_m[::_CLASS_STRIDE] if o.ground_plane is not None else o.lidar_map_xyz_m[:0]
    plane = o.ground_plane if o.ground_plane is not None else np.zeros(4)
    height = np.digitize(xyz @ plane[:3] + plane[3], _CLASS_HEIGHTS_M)
    class_ = (height * 3 + np.digitize(np.linalg.norm(xyz, axis=1), _CLASS_RANGES_M)).astype(np.uint8)
    return xyz, class_, class_, np.zeros(len(xyz), np.float32)


def _gather(
    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
    T_camera_lidar: np.ndarray,
    camera: Camera,
    reach_rad: float,
) -> Points:
    """Points of all frames in or near the camera's field of view."""
    bounds = view_bounds(camera)
    kept, counts = [], [0]
    for xyz, side, kind, gap in frames:
        near = is_near_view(xyz, T_camera_lidar, bounds, reach_rad)
        kept.append((xyz[near], side[near], kind[near], gap[near]))
        counts.append(counts[-1] + int(near.sum()))
    columns = [np.concatenate(c) for c in zip(*kept, strict=True)]
    return Points(
        np.ascontiguousarray(columns[0], np.float32),
        np.array(counts, np.int64),
        columns[1].astype(np.uint8),
        columns[2].astype(np.uint8),
        columns[3].astype(np.float32),
        np.zeros(len(columns[0]), np.float32),
        np.arange(len(frames), dtype=np.int64),
    )
