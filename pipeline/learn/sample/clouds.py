"""Lidar and radar points of one frame as arrays of fixed size: thinned evenly, with flags, padded with zeros."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Integer, UInt8
from scipy.spatial import cKDTree

from pipeline.core.config import PrepareConfig
from pipeline.learn.sample.grid import Grid
from pipeline.rig.estimates import Prior
from pipeline.rig.scan_rows import rows_of
from pipeline.rig.se3 import camera_direction_angles, to_spherical, transform_points
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import POINT_IS_EDGE, POINT_IS_GROUND

__all__ = ["View", "lidar_columns", "own_velocity", "padded_rows", "radar_columns", "range_edges"]

_NEAR_M, _FAR_M = 2.5, 120.0
_MARGIN_RAD = np.radians(6.0)  # beyond the grid: what a guess wrong by so much still brings into view
_SLOW_MPS = 3.0  # a slower car's Doppler shows no direction
_SAME_POINT_M = 0.5  # a point of the sweep and its voxel's in the map are nearer than this
_LOSS_RANGE_M = 80.0  # the paper's far limit
_CLUSTERS, _DETECTIONS, _TRACKS = 48, 384, 24
# As in perception: a jump must exceed both, and a beam may be missing between the two.
_JUMP_M, _JUMP_FRACTION, _JUMP_STEPS = 0.8, 0.06, 2.6


@dataclass(frozen=True, eq=False)
class View:
    """The camera's grid about the optical axis with a margin, at the poses of `prior`."""

    prior: Prior
    grid: Grid

    def angles(self, xyz_m: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Azimuth and elevation in the camera of points in the lidar frame."""
        return camera_direction_angles(transform_points(self.prior.T_camera_lidar, xyz_m.astype(np.float64)))

    def contains(self, angles: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """True inside the grid and its margin."""
        limit = np.radians([self.grid.left_deg, self.grid.top_deg]) + _MARGIN_RAD
        return np.all(np.abs(angles) <= limit, axis=1)


def lidar_columns(
    frame: Frame, observation: Observation, view: View, config: PrepareConfig, rng: np.random.Generator
) -> dict[str, Any]:
    """Columns of table `training` computed from the lidar; `view` determines which points are kept.

    Input points are of the sweep at its stamp: at most one per cell of the grid, then others up to the array's
    size. They do not depend on the camera's image.
    """
    count, xyz = config.lidar_points, _at_stamp(frame, observation, view.prior.T_lidar_radar)
    flags = range_edges(xyz, frame.lidar_ring).astype(np.uint8) * POINT_IS_EDGE
    distance = np.linalg.norm(xyz, axis=1)
    angles = view.angles(xyz)
    inside = view.contains(angles) & (distance > _NEAR_M) & (distance < _FAR_M)  # NaN: not inside
    step_rad = float(np.radians(view.grid.cell_deg))
    rows = _thinned(np.flatnonzero(inside), angles, step_rad, count, rng)
    flags[rows] |= _ground_flags(xyz[rows], observation) * POINT_IS_GROUND
    rank = _ranks(frame.lidar_intensity, len(xyz))
    values = {"lidar_xyz_m": xyz, "lidar_intensity": rank, "lidar_flags": flags}
    columns = {name: padded_rows(of_points[rows], count) for name, of_points in values.items()}
    beside = _cluster_columns(observation, view) | _edge_columns(observation, view, config.edge_points, rng)
    return columns | {"lidar_count": len(rows)} | beside


def own_velocity(
    observation: Observation, T_lidar_radar: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " 3"]:
    """Level velocity in the lidar frame [m/s]: the speed in the direction of the radar's Doppler, else along x."""
    velocity, speed = observation.radar_velocity_mps, observation.ego_speed_mps or 0.0
    ahead = np.array([1.0, 0.0])
    if velocity is not None and np.isfinite(T_lidar_radar).all():
        level = (T_lidar_radar[:3, :3] @ velocity)[:2]
        if abs(speed) > _SLOW_MPS:
            ahead = np.sign(speed) * level / max(float(np.hypot(*level)), 1e-6)
    return speed * np.append(ahead, 0.0)


def _at_stamp(
    frame: Frame, observation: Observation, T_lidar_radar: Float[np.ndarray, "4 4"]
) -> Float32[np.ndarray, "N 3"]:
    """The sweep as perception saw it: moved to its stamp, if it was logged as measured and perception did so."""
    time_s = frame.lidar_time_s
    if frame.lidar_deskewed or time_s is None or observation.lidar_map_time_s is None:
        return frame.lidar_xyz_m
    moved = time_s.astype(np.float64)[:, None] * own_velocity(observation, T_lidar_radar)
    return (frame.lidar_xyz_m + moved).astype(np.float32)


def range_edges(
    xyz_m: Float[np.ndarray, "N 3"], ring: Integer[np.ndarray, " N"] | None
) -> Bool[np.ndarray, " N"]:
    """True for points in front of their neighbour along the ring by a jump in range.

    Only ranges are used, because the class of an object would reveal its mask. All are False if the sweep has
    no rows: neighbours then differ in elevation, so even the ground has jumps in range.
    """
    out = np.zeros(len(xyz_m), bool)
    finite = np.flatnonzero(np.isfinite(xyz_m).all(axis=1))
    if len(finite) < 2:
        return out
    aer = to_spherical(xyz_m[finite].astype(np.float64))
    rows = rows_of(aer, None if ring is None else ring[finite].astype(np.uint16))
    if rows is None:
        return out
    azimuth, _, distance = aer.T
    row, order = rows
    step = np.diff(azimuth[order])
    along = np.diff(row[order]) == 0
    nominal = np.median(step[along & (step > 1e-5)]) if np.any(along & (step > 1e-5)) else 0.0
    rise = np.diff(distance[order])
    nearer = np.minimum(distance[order][1:], distance[order][:-1])
    jump = along & (step <= _JUMP_STEPS * nominal)
    jump &= np.abs(rise) > np.maximum(_JUMP_M, _JUMP_FRACTION * nearer)
    out[finite[order[:-1][jump & (rise > 0)]]] = True
    out[finite[order[1:][jump & (rise < 0)]]] = True
    return out


def radar_columns(observation: Observation, rng: np.random.Generator) -> dict[str, Any]:
    """Columns of table `training` computed from the radar."""
    picked = _some(len(observation.radar_xyz_m), _DETECTIONS, rng)
    power = observation.radar_power_db
    relative = np.zeros(len(picked)) if power is None else power[picked] - np.nanmedian(power)
    return {
        "radar_xyz_m": padded_rows(observation.radar_xyz_m[picked], _DETECTIONS),
        "radar_residual_mps": padded_rows(np.nan_to_num(observation.radar_residual_mps[picked]), _DETECTIONS),
        "radar_power_db": padded_rows(np.nan_to_num(relative), _DETECTIONS),
        "radar_motion": padded_rows(observation.radar_motion[picked], _DETECTIONS),
        "radar_count": len(picked),
        "radar_has_elevation": observation.radar_has_elevation,
        "track_xyz_m": padded_rows(observation.radar_track_xyz_m[:_TRACKS], _TRACKS),
        "track_count": min(len(observation.radar_track_xyz_m), _TRACKS),
    }


def padded_rows(values: np.ndarray, count: int) -> np.ndarray:
    """The values, followed by zeros."""
    out = np.zeros((count, *values.shape[1:]), values.dtype)
    out[: len(values)] = values
    return out


def _thinned(
    rows: np.ndarray, angles: np.ndarray, step_rad: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """At most `count` row numbers in order: first one random row per cell, then random others."""
    rows = rng.permutation(rows)
    cell = np.floor(angles[rows] / step_rad).astype(np.int64)
    _, first = np.unique(cell[:, 0] * 100_000 + cell[:, 1], return_index=True)
    others = np.setdiff1d(np.arange(len(rows)), first, assume_unique=True)
    first = rng.permutation(first)[:count]
    return np.sort(rows[np.concatenate([first, others[: count - len(first)]])])


def _ground_flags(xyz_m: np.ndarray, observation: Observation) -> np.ndarray:
    """1 for ground points of perception's map, which has one point per voxel."""
    if not len(observation.lidar_map_xyz_m) or not len(xyz_m):
        return np.zeros(len(xyz_m), np.uint8)
    _, nearest = cKDTree(observation.lidar_map_xyz_m).query(xyz_m, distance_upper_bound=_SAME_POINT_M)
    is_ground = np.append(observation.lidar_map_is_ground, 0)  # one behind the last: none
    return is_ground.astype(np.uint8)[nearest]


def _ranks(intensity: np.ndarray | None, count: int) -> UInt8[np.ndarray, " N"]:
    """Rank of each reflectivity within its sweep, 0..255: lidars differ in scale, not in order."""
    if intensity is None:
        return np.zeros(count, np.uint8)
    values = np.sort(intensity)
    rank = (np.searchsorted(values, intensity, "left") + np.searchsorted(values, intensity, "right")) / 2
    return np.rint(rank * (255.0 / max(count, 1))).astype(np.uint8)


def _cluster_columns(observation: Observation, view: View) -> dict[str, Any]:
    cloud, cluster = observation.lidar_map_xyz_m, observation.lidar_map_cluster
    distance = np.linalg.norm(cloud, axis=1)
    inside = (cluster >= 0) & (distance > _NEAR_M) & (distance < _LOSS_RANGE_M)
    inside &= view.contains(view.angles(cloud))
    # Clusters are numbered by size: the largest of those in view.
    largest = np.unique(cluster[inside])[:_CLUSTERS]
    return {
        "cluster_centre_m": padded_rows(observation.lidar_cluster_centre_m[largest], _CLUSTERS),
        "cluster_count": len(largest),
    }


def _edge_columns(
    observation: Observation, view: View, count: int, rng: np.random.Generator
) -> dict[str, Any]:
    rows = np.flatnonzero(view.contains(view.angles(observation.lidar_edge_xyz_m)))
    picked = rows[_some(len(rows), count, rng)]
    return {
        "edge_xyz_m": padded_rows(observation.lidar_edge_xyz_m[picked], count),
        "edge_side": padded_rows(observation.lidar_edge_side[picked], count),
        "edge_count": len(picked),
        "ground_plane": np.zeros(4) if observation.ground_plane is None else observation.ground_plane,
    }


def _some(available: int, count: int, rng: np.random.Generator) -> Int[np.ndarray, " K"]:
    """At most `count` row numbers, in order."""
    if available <= count:
        return np.arange(available)
    return np.sort(rng.choice(available, count, replace=False))
