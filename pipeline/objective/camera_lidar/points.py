"""Points of the camera-lidar terms: gathered from observations, in or near the camera's view, sorted into kinds.

Rolling shutter: the rows of an image are exposed from the top to the bottom during the readout time; the
frame's time is that of the middle row. A point on row v of h was exposed ((v + 1/2)/h - 1/2) readouts later,
after the car had moved on. Stamps that mean the first or the last row are half a readout off, which the time
offset takes up like any other clock.

Points are moved once for one pose, not in the loops over poses, because the change of a point's row between
poses changes its delay by only a few hundredths.

Source: Meingast, Geyer, Sastry 2005, section 3 (projection along a row's own pose).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float

from pipeline.objective.ego_motion import shown_heading
from pipeline.objective.stamp_gaps import turned
from pipeline.rig.cameras import Camera
from schemas.observations import Observation

__all__ = [
    "CLASSES", "EDGE_KINDS", "Points", "exposed", "gathered", "is_near_view", "lidar_velocities",
    "motion_in_camera", "moving_poses", "row_delays_s", "view_bounds",
]  # fmt: skip

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
_ROUNDS = 2  # the second moves rows by what the first left: a hundredth of the delay at most


@dataclass(frozen=True, eq=False)
class Points:
    """Points of F frames, one after the other: frame f has rows start[f]:start[f+1]; lidar frame.

    Frame f uses the maps of row image[f], so that maps need not be copied for a selection of frames.

    `exposure_s` is the time of a point's image row after the middle row, if points were moved to that time
    (`exposed`).
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
        return self._rows(keep, np.concatenate([[0], np.cumsum(keep)])[self.start], self.image)

    def of_frames(self, frames: np.ndarray) -> Points:
        """The points of some frames, in the order given."""
        rows = [np.arange(self.start[f], self.start[f + 1]) for f in frames]
        start = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
        return self._rows(np.concatenate([np.empty(0, np.int64), *rows]), start, self.image[frames])

    def _rows(self, rows: np.ndarray, start: np.ndarray, image: np.ndarray) -> Points:
        columns = (self.side, self.kind, self.gap_rad, self.exposure_s)
        side, kind, gap_rad, exposure_s = (c[rows] for c in columns)
        return Points(self.xyz_m[rows], start, side, kind, gap_rad, exposure_s, image)


def gathered(
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    camera: Camera,
    reach_rad: float,
) -> tuple[Points, Points, Points]:
    """Points in the camera's view or near it: depth jumps with direction and kind, markings, the sampled cloud.

    Markings are ground points with a higher reflectivity than the road; the cloud has its class of height and range.
    """
    edges, markings, bounds = [], [], view_bounds(camera)

    def near(frames: Sequence[tuple[np.ndarray, ...]]) -> Points:
        return _gather(frames, T_camera_lidar, bounds, reach_rad)

    for o, kind in zip(observations, _kinds(observations), strict=True):
        edges.append((o.lidar_edge_xyz_m, o.lidar_edge_side, kind, o.lidar_edge_gap_rad))
        bright = o.marking_xyz_m[o.marking_z > _MARKING_Z]
        markings.append((bright, *[np.zeros(len(bright), np.uint8)] * 3))
    return near(edges), near(markings), near([_height_classes(o) for o in observations])


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


def _height_classes(o: Observation) -> tuple[np.ndarray, ...]:
    """Every eighth point of the sampled cloud with its class; none if the road was not found."""
    xyz = o.lidar_map_xyz_m[::_CLASS_STRIDE] if o.ground_plane is not None else o.lidar_map_xyz_m[:0]
    plane = o.ground_plane if o.ground_plane is not None else np.zeros(4)
    height = np.digitize(xyz @ plane[:3] + plane[3], _CLASS_HEIGHTS_M)
    class_ = (height * 3 + np.digitize(np.linalg.norm(xyz, axis=1), _CLASS_RANGES_M)).astype(np.uint8)
    return xyz, class_, class_, np.zeros(len(xyz), np.float32)


def _gather(
    frames: Sequence[tuple[np.ndarray, ...]],
    T_camera_lidar: np.ndarray,
    bounds: np.ndarray,
    reach_rad: float,
) -> Points:
    """Points of all frames in or near the camera's field of view."""
    kept, counts = [], [0]
    for xyz, side, kind, gap in frames:
        near = is_near_view(xyz, T_camera_lidar, bounds, reach_rad)
        kept.append((xyz[near], side[near], kind[near], gap[near]))
        counts.append(counts[-1] + int(near.sum()))
    columns = [np.concatenate(c) for c in zip(*kept, strict=True)]
    return Points(
        np.ascontiguousarray(columns[0], np.float32), np.array(counts, np.int64), columns[1].astype(np.uint8),
        columns[2].astype(np.uint8), columns[3].astype(np.float32), np.zeros(len(columns[0]), np.float32),
        np.arange(len(frames), dtype=np.int64),
    )  # fmt: skip


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def moving_poses(
    R: np.ndarray, t: np.ndarray, dt_s: np.ndarray, gap_s: np.ndarray, velocity: np.ndarray,
    yaw_rate: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """[R Rz(yaw_rate tau) | R Rz(yaw_rate tau) v tau + t] as rows, tau = dt - gap, for each pose and frame."""
    count, frames = R.shape[0], velocity.shape[0]
    out = np.empty((count, frames, 12), np.float32)
    for p in range(count):
        for f in range(frames):
            tau = dt_s[p] - gap_s[f]
            c, s = np.cos(yaw_rate[f] * tau), np.sin(yaw_rate[f] * tau)
            for i in range(3):
                a, b, d = c * R[p, i, 0] + s * R[p, i, 1], c * R[p, i, 1] - s * R[p, i, 0], R[p, i, 2]
                ahead = a * velocity[f, 0] + b * velocity[f, 1] + d * velocity[f, 2]
                row = 4 * i
                out[p, f, row], out[p, f, row + 1], out[p, f, row + 2] = a, b, d
                out[p, f, row + 3] = ahead * tau + t[p, i]
    return out


def motion_in_camera(
    poses: Float[np.ndarray, "F 12"],
    t_camera_lidar: Float[np.ndarray, " 3"],
    velocity_lidar: Float[np.ndarray, "F 3"],
    yaw_rate: Float[np.ndarray, " F"],
) -> Float[np.ndarray, "F 4"]:
    """Velocity in camera axes and yaw rate: a point moves by velocity + yaw_rate up x (point - pose's translation)."""
    rows = poses.reshape(-1, 3, 4)
    # The turn is about the lidar, which is where the pose's translation was before the way driven.
    turn = yaw_rate[:, None] * np.cross(rows[:, :, 2], rows[:, :, 3] - t_camera_lidar)
    velocity = np.einsum("fij,fj->fi", rows[:, :, :3], velocity_lidar) + turn
    return np.column_stack([velocity, yaw_rate])


def lidar_velocities(
    observations: Sequence[Observation],
    T_lidar_radar: Float[np.ndarray, "4 4"],
    heading_rad: float | None = None,
) -> Float[np.ndarray, "F 3"]:
    """Own velocity in lidar axes [m/s]: the speed along one heading of the day, in the horizontal plane.

    Args:
        observations: whose speeds are taken, 0 where unknown.
        T_lidar_radar: turns the radar's Doppler into the heading; where no radar shows it, it is the lidar's
            x axis.
        heading_rad: azimuth of the heading where it is known otherwise.
    """
    speed = np.array([o.ego_speed_mps if o.ego_speed_mps is not None else 0.0 for o in observations])
    heading = (shown_heading(observations, T_lidar_radar) or 0.0) if heading_rad is None else heading_rad
    return speed[:, None] * np.array([np.cos(heading), np.sin(heading), 0.0])


def row_delays_s(v_px: Float[np.ndarray, " N"], height_px: int, readout_s: float) -> Float[np.ndarray, " N"]:
    """Time of image rows after the middle one [s]; rows outside the image count as its border."""
    return (np.clip((v_px + 0.5) / height_px, 0.0, 1.0) - 0.5) * readout_s


def exposed(
    points: Points, poses: Float[np.ndarray, "F 12"], camera: Camera,
    velocity_lidar: Float[np.ndarray, "F 3"], yaw_rate: Float[np.ndarray, " F"], readout_s: float,
) -> Points:  # fmt: skip
    """Points where their image rows saw them.

    Args:
        points: of F frames, at the time of the middle row or as an earlier call left them.
        poses: rows of the 3x4 transform into the camera at the time of the middle row, by frame.
        camera: at the size of the label images.
        velocity_lidar: own velocity in lidar axes [m/s]; the one that an earlier call had.
        yaw_rate: own [rad/s].
        readout_s: from the first row to the last (negative: from the last to the first); 0 puts the points
            back to the time of the middle row.
    """
    frame = np.repeat(np.arange(len(poses)), np.diff(points.start))
    velocity, turn = velocity_lidar[frame], yaw_rate[frame]
    still = turned(points.xyz_m.astype(np.float64), turn * points.exposure_s)
    still += velocity * points.exposure_s[:, None]
    exposure_s, moved = np.zeros(len(frame)), still
    for _ in range(_ROUNDS if readout_s else 0):
        rows = poses[frame].reshape(-1, 3, 4).astype(np.float64)
        uv, valid = camera.project(np.einsum("nij,nj->ni", rows[:, :, :3], moved) + rows[:, :, 3])
        exposure_s = np.where(valid, row_delays_s(uv[:, 1], camera.height_px, readout_s), 0.0)
        # The car was there `exposure_s` later, so static objects were nearer by its motion.
        moved = turned(still - velocity * exposure_s[:, None], -turn * exposure_s)
    return replace(points, xyz_m=moved.astype(np.float32), exposure_s=exposure_s.astype(np.float32))
