"""Direction of travel, in radar axes by Doppler and in lidar axes by the road: it determines the radar's pitch.

It needs neither a camera nor a match of detections with lidar points. A static detection in direction u has
the range rate `-u . v`, so a scan gives three components of v. On average the car drives along its road.

The vertical component is difficult. Elevations have the largest noise of all radar measurements, and least
squares on them biases v towards the mean elevation of the detections (errors in variables: by half a degree
in simulation, by more if noise is as large as the spread). So the equations use an instrumental variable: the
mean elevation of lidar points at the detection's azimuth and range, at any height. It is correlated with the
true elevation and independent of the radar's noise.

Instruments do not correct detections measured too low, between an object and its image in the road, because
high objects are displaced more. With heights too low by a tenth, the velocity points lower by .3 to .9 deg.
Its size on a day is unknown; the share of detections below the road limits it.

The road is modelled as a parabola in the direction of travel, with its slope under the car. A plane through
points 7 to 35 m ahead had an error of 0.3 to 0.5 deg on hilly streets.

A constant error of all elevations rotates v in radar axes like the detections, so the result is the pitch of
the detections.

Source: Kellner et al. 2014, "Instantaneous ego-motion estimation using multiple Doppler radars", for three
components from one; Durbin 1954, "Errors in variables", for instruments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64

from pipeline.core.rows import columns_of
from pipeline.objective.radar.registration import (
    RANGE_M,
    SIDE_RAD,
    equations_by_frame,
    rows_of_frames,
    spread_of,
)
from pipeline.rig.se3 import hat, inverse, transform_points
from schemas.observations import Observation

__all__ = [
    "DOPPLER_PITCH_FLOOR_RAD",
    "TravelDirections",
    "pitch_equations",
    "pitch_residuals",
    "travel_directions",
]

# Pitch by the car's way, Doppler against road: errors on 12 simulated days of seeds 140 to 153 (40 frames, 96 and 16
# rows) were 0.11 deg RMS where the frames' scatter gave 0.08; on a real day three sizes of the window for the lidar's
# elevations moved it by 0.2 deg RMS.
DOPPLER_PITCH_FLOOR_RAD = np.radians(0.15)
_LEAST_SPEED_MPS = 5.0  # slower, a vertical error of 0.05 m/s is half a degree
_LEAST_DETECTIONS = 30
_SINGULAR = 1e-9
_CELL_RAD, _CELL_M = np.radians(0.5), 0.25
_WINDOW = 3  # cells to each side: 1.75 deg and 0.9 m, some sigmas of any car radar
_LEAST_LIDAR_POINTS = 2
_ROAD_M, _ROAD_ASIDE_M, _ROAD_BIN_M = 25.0, 6.0, 2.0
_ROAD_POINTS = 40
_FLAT_M = 0.01
_PASSES = 6
_LEAST_FRAMES = 5  # fewer show no scatter
_LEAST_SCATTER_RAD = np.radians(0.1)  # springs and road
_DISPLACED = 0.05  # of all heights: the share at which what it does to the velocity is measured
_BELOW_M = -0.3  # over the road: lower, a detection was not seen where it is
_ROW = np.dtype(
    [
        ("velocity_mps", "f8", 3),
        ("sigma_rad", "f8"),
        ("slope", "f8"),
        ("per_displaced", "f8"),
        ("below", "f8"),
        ("height_rad", "f8"),
        ("frame", "i8"),
    ]
)


@dataclass(frozen=True, eq=False)
class TravelDirections:
    """The radar's velocity and the road's slope along it, one frame per row."""

    velocity_mps: Float[np.ndarray, "D 3"]  # radar axes
    sigma_rad: Float[np.ndarray, " D"]  # of the velocity's elevation, by the scan alone
    slope: Float[np.ndarray, " D"]  # of the road along the velocity, lidar axes; up positive
    # By how much the velocity points higher [rad] per share of their height that detections are seen too low.
    per_displaced: Float[np.ndarray, " D"]
    below: Float[np.ndarray, " D"]  # share of the detections that are seen below the road
    height_rad: Float[np.ndarray, " D"]  # of the detections over the road, mean angle as the radar sees it
    frame: Int64[np.ndarray, " D"]  # index into the observations given

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.frame)

    def bias_rad(self, share: float | None = None) -> float:
        """Sigma of pitch that more frames do not reduce, for objects measured too low by this share of their height.

        The default is the share of detections below the road.
        """
        if not self.count:
            return float(DOPPLER_PITCH_FLOOR_RAD)
        share = float(np.mean(self.below)) if share is None else share
        return float(np.hypot(DOPPLER_PITCH_FLOOR_RAD, np.median(self.per_displaced) * share))

    def of_frames(self, frames: Int64[np.ndarray, " S"]) -> TravelDirections:
        """The part of some observations, which are renumbered in the given order."""
        return rows_of_frames(self, frames)


def travel_directions(
    observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"], dt_s: float
) -> TravelDirections:
    """Directions of travel from moving frames, without flat radars and empty streets.

    `T_lidar_radar`, good to a degree of azimuth, only selects lidar points near a detection.
    """
    rows = []
    for index, o in enumerate(observations):
        v = o.radar_velocity_mps
        if not o.radar_has_elevation or v is None or np.hypot(v[0], v[1]) < _LEAST_SPEED_MPS:
            continue
        scan = _scan(o, T_lidar_radar, dt_s)
        if scan is None:
            continue
        found = _velocity(scan, v)
        if found is None:
            continue
        velocity, covariance = found
        in_lidar = T_lidar_radar[:3, :3] @ velocity
        ahead = in_lidar[:2] / np.hypot(*in_lidar[:2])
        road = _road(o, ahead)
        if road is None:
            continue
        up = T_lidar_radar[2, :3]
        height_m = _heights(scan.xyz_m, T_lidar_radar, road, ahead)
        righted = _velocity(replace(scan, xyz_m=scan.xyz_m + _DISPLACED * height_m[:, None] * up), v)
        if righted is not None:
            size = np.linalg.norm(velocity)
            sigma = float(np.sqrt(up @ covariance @ up) / size)
            per_displaced = float(up @ (velocity - righted[0])) / size / _DISPLACED
            below = float(np.mean(height_m < _BELOW_M))
            height_rad = float(np.mean(height_m / np.linalg.norm(scan.xyz_m, axis=1)))
            rows.append((velocity, sigma, road[1], per_displaced, below, height_rad, index))
    return TravelDirections(**columns_of(rows, _ROW))


def pitch_residuals(
    travel: TravelDirections, T_lidar_radar: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, "D 3"]]:
    """Angle of the velocity above the road [rad], and its Jacobian for a rotation R <- exp(r) R."""
    v = travel.velocity_mps @ T_lidar_radar[:3, :3].T
    x, y, z = v.T
    h = np.hypot(x, y)
    r2 = h * h + z * z
    gradient = np.stack([-x * z / (h * r2), -y * z / (h * r2), h / r2], -1)
    return np.arctan2(z, h) - np.arctan(travel.slope), -(gradient[:, None, :] @ hat(v))[:, 0]


def pitch_equations(
    travel: TravelDirections, T_lidar_radar: Float[np.ndarray, "4 4"], frames: int
) -> tuple[Float[np.ndarray, "F 2 2"], Float[np.ndarray, "F 2"], float]:
    """Information and gradient per frame of the robust (Cauchy) cost for roll and pitch, and the scatter [rad].

    The scatter is that of frames in excess of their sigmas, to which it is added; NaN for too few frames.
    """
    if travel.count < _LEAST_FRAMES:
        return np.zeros((frames, 2, 2)), np.zeros((frames, 2)), float("nan")
    residual, J = pitch_residuals(travel, T_lidar_radar)
    common = max(spread_of(residual) ** 2 - float(np.median(travel.sigma_rad)) ** 2, _LEAST_SCATTER_RAD**2)
    variance = travel.sigma_rad**2 + common
    weight = 1 / (variance + residual**2 / 4)
    H, g = equations_by_frame(weight, residual, J[:, :2], travel.frame, frames)
    return H, g, float(np.sqrt(common))


@dataclass(frozen=True, eq=False)
class _Scan:
    """Static detections that have an instrument."""

    xyz_m: np.ndarray
    rate_mps: np.ndarray
    lidar_rad: np.ndarray  # elevation of what the lidar sees there


def _scan(o: Observation, T_lidar_radar: np.ndarray, dt_s: float) -> _Scan | None:
    """Detections of one scan; None if too few have an instrument."""
    assert o.radar_velocity_mps is not None
    static = o.radar_motion == 0
    xyz, residual = o.radar_xyz_m[static].astype(np.float64), o.radar_residual_mps[static].astype(np.float64)
    lidar = _lidar_elevation(o, T_lidar_radar, dt_s, xyz)
    seen = np.isfinite(lidar)
    if seen.sum() < _LEAST_DETECTIONS:
        return None
    xyz = xyz[seen]
    u = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    return _Scan(xyz, residual[seen] - u @ o.radar_velocity_mps, lidar[seen])


def _velocity(scan: _Scan, near_mps: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Velocity and covariance of one scan by instruments, from a velocity near it; None if undetermined."""
    u = scan.xyz_m / np.linalg.norm(scan.xyz_m, axis=1, keepdims=True)
    azimuth = np.arctan2(scan.xyz_m[:, 1], scan.xyz_m[:, 0])
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(scan.lidar_rad)], 1)
    Z = flat * np.cos(scan.lidar_rad)[:, None]
    M = Z.T @ u
    if abs(np.linalg.det(M)) < _SINGULAR * len(Z) ** 3:
        return None
    # No robust weights: noise of an elevation moves the residual one way more than the other, by how steep the
    # detection is seen, and what cuts that off is biased. Static detections lie within their gate as it is.
    M_inverse = np.linalg.inv(M)
    residual = scan.rate_mps + u @ near_mps
    step = -M_inverse @ (Z.T @ residual)
    score = Z * (residual + u @ step)[:, None]
    return near_mps + step, M_inverse @ (score.T @ score) @ M_inverse.T


def _heights(xyz_m: np.ndarray, T_lidar_radar: np.ndarray, road: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Height of detections over the plane of the road under the car."""
    x, y, z = transform_points(T_lidar_radar, xyz_m).T
    along, aside = x * ahead[0] + y * ahead[1], y * ahead[0] - x * ahead[1]
    return np.asarray(z - road[0] - road[1] * along - road[3] * aside)


def _lidar_elevation(o: Observation, T_lidar_radar: np.ndarray, dt_s: float, xyz_m: np.ndarray) -> np.ndarray:
    """Mean elevation [rad] of lidar points around each detection's azimuth and range; NaN without points."""
    assert o.radar_velocity_mps is not None
    lidar = transform_points(inverse(T_lidar_radar), o.lidar_map_xyz_m.astype(np.float64))
    lidar -= o.radar_velocity_mps * ((o.radar_stamp_ns - o.stamp_ns) * 1e-9 + dt_s)
    size = (int(np.ceil(2 * SIDE_RAD / _CELL_RAD)), int(np.ceil(RANGE_M[1] / _CELL_M)))
    (rows, columns, inside), (row, column, usable) = _cells(lidar, size), _cells(xyz_m, size)
    flat = rows[inside] * size[1] + columns[inside]
    elevation = np.arctan2(lidar[inside, 2], np.hypot(lidar[inside, 0], lidar[inside, 1]))
    count, total = (
        _window_sums(np.bincount(flat, w, size[0] * size[1]).reshape(size)) for w in (None, elevation)
    )
    out = np.full(len(xyz_m), np.nan)
    points = count[row[usable], column[usable]]
    enough = points >= _LEAST_LIDAR_POINTS
    mean = total[row[usable], column[usable]] / np.maximum(points, 1)
    out[np.flatnonzero(usable)[enough]] = mean[enough]
    return out


def _cells(xyz_m: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell of azimuth and of range of each point, and whether the point is within the useful view."""
    row = np.floor((np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) + SIDE_RAD) / _CELL_RAD).astype(np.int64)
    range_m = np.linalg.norm(xyz_m, axis=1)
    column = np.floor(range_m / _CELL_M).astype(np.int64)
    inside = (row >= 0) & (row < size[0]) & (range_m > RANGE_M[0]) & (column < size[1])
    return row, column, inside


def _window_sums(cells: np.ndarray) -> np.ndarray:
    """Sum over a window around each cell."""
    padded = np.pad(cells, ((_WINDOW + 1, _WINDOW), (_WINDOW + 1, _WINDOW))).cumsum(0).cumsum(1)
    n = 2 * _WINDOW + 1
    return np.asarray(padded[n:, n:] - padded[:-n, n:] - padded[n:, :-n] + padded[:-n, :-n])


def _road(o: Observation, ahead: np.ndarray) -> np.ndarray | None:
    """Road under the lidar, a robust parabola along a horizontal direction: height, slope, bend, slope to the left."""
    ground = o.lidar_map_xyz_m[o.lidar_map_is_ground.astype(bool)].astype(np.float64)
    along, aside = ground[:, :2] @ ahead, ground[:, :2] @ np.array([-ahead[1], ahead[0]])
    near = (np.abs(along) < _ROAD_M) & (np.abs(aside) < _ROAD_ASIDE_M)
    if near.sum() < _ROAD_POINTS:
        return None
    along, aside, z = along[near], aside[near], ground[near, 2]
    A = np.stack([np.ones_like(along), along, along**2, aside], 1)
    # Rings crowd near the car: each stretch of road counts alike.
    stretch = ((along + _ROAD_M) / _ROAD_BIN_M).astype(np.int64)
    even = 1 / np.bincount(stretch)[stretch]
    weight, solution = even, np.zeros(4)
    for _ in range(_PASSES):
        solution = np.linalg.lstsq((A.T * weight) @ A, (A.T * weight) @ z, rcond=None)[0]
        r = z - A @ solution
        sigma = max(1.4826 * float(np.median(np.abs(r))), _FLAT_M)
        weight = even / (1 + (r / (2 * sigma)) ** 2)
    return solution
