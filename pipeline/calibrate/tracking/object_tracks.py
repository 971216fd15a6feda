"""Tracks of road users by radar, lidar and camera, each in the sensor's own levelled axes.

Radar: the moving clusters that perception tracks. Lidar: clusters of a road user's size and height above the
ground, tracked here; against the radar, only those that move over ground. Camera: boxes of road users, with a
range from the usual height of their class, as a monocular 3D detector would estimate it (about 20 %). Boxes
of parked road users are included; they pass by the sensors like any other.

No other sensor's pose is needed: the own motion between two frames comes from the car. The filter lives in the ground
plane; heights are reported as measured.

Source: Persic, Petrovic, Markovic, Petrovic, "Online multi-sensor calibration based on moving object tracking",
Advanced Robotics 35, 2021, whose detections by lidar and camera come from 3D networks: clusters and sized boxes stand
for these here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from scipy.spatial import cKDTree

from pipeline.core.rows import take_rows
from pipeline.objective.radar.moving_clusters import ROAD_USER_HEIGHT_M
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Prior
from pipeline.rig.ground_tracks import Filters, Measurements, advance, carried, lines_of_sight, new_filters
from pipeline.rig.se3 import camera_direction_angles, from_spherical
from schemas.observations import Observation

__all__ = [
    "Motion", "Scan", "Track", "box_centres", "camera_tracks", "follow", "lidar_tracks", "motions", "moves_over_ground",
    "passes_by", "radar_tracks", "turn_between",
]  # fmt: skip

_SPEED_SIGMA_MPS = 15.0  # of a new track, over ground, about standing still
_GATE, _MAX_MISSED_S = 9.2, 1.5  # chi^2 with 2 degrees of freedom, 99 %


@dataclass(frozen=True)
class Motion:
    """Own motion of a sensor: velocity in its own axes [m/s] (None: unknown) and yaw rate with its sigma [rad/s]."""

    velocity_mps: tuple[float, float] | None
    yaw_rate_radps: float = 0.0
    yaw_rate_sigma_radps: float = 0.08


@dataclass(frozen=True, eq=False)
class Scan:
    """Detections of one frame in level axes, with the covariance of each in the plane."""

    frame: int
    drive: int
    stamp_ns: int
    motion: Motion
    centre_m: Float[np.ndarray, "K 3"]
    covariance_m2: Float[np.ndarray, "K 2 2"]


@dataclass(frozen=True, eq=False)
class Track:
    """Track of one object by one sensor: a row per sighting, in levelled sensor axes, with velocity over ground."""

    drive: int
    frame: Int64[np.ndarray, " N"]  # index into the observations
    detection: Int64[np.ndarray, " N"]  # index within the frame
    position_m: Float[np.ndarray, "N 3"]
    velocity_mps: Float[np.ndarray, "N 3"]
    rate_sigma_mps: Float[np.ndarray, " N"]  # of the velocity along the line of sight
    range_sigma_m: Float[np.ndarray, " N"]
    target_m: Float[np.ndarray, "N 3"]  # the point that another sensor's bearing means

    @property
    def sightings(self) -> int:
        """Number of frames that it was seen in."""
        return len(self.frame)


def follow(scans: Sequence[Scan]) -> list[Track]:
    """Tracks of at least two sightings, in order; a new drive, a gap above 2.5 s or unknown motion ends all.

    Positions are the measured ones, without the filter's lag. `scans` are in order of time.
    """
    filters, count, before = Filters.none(), 0, None
    sightings: list[list[tuple[Scan, int, np.ndarray, float]]] = []
    for scan in scans:
        filters, identity = advance(
            _carried(filters, before, scan), _measured(scan), _born, count, _GATE, _MAX_MISSED_S
        )
        count = max(count, int(identity.max(initial=-1)) + 1)
        sightings += [[] for _ in range(count - len(sightings))]
        rows = {int(i): row for row, i in enumerate(filters.identity)}
        for k, i in enumerate(identity.tolist()):
            velocity, sigma = filters.state[rows[i], 2:], _rate_sigma(filters, rows[i])
            sightings[i].append((scan, k, velocity, sigma))
        before = scan
    return [_track(s) for s in sightings if len(s) > 1]


def _carried(filters: Filters, before: Scan | None, scan: Scan) -> Filters:
    if before is None or before.drive != scan.drive:
        return Filters.none()
    a, b = before.motion, scan.motion
    rate = 0.5 * (a.yaw_rate_radps + b.yaw_rate_radps), max(a.yaw_rate_sigma_radps, b.yaw_rate_sigma_radps)
    return carried(filters, (scan.stamp_ns - before.stamp_ns) / 1e9, (a.velocity_mps, b.velocity_mps), rate)


def _measured(scan: Scan) -> Measurements:
    H = np.broadcast_to(np.eye(2, 4), (len(scan.centre_m), 2, 4))
    return Measurements(scan.stamp_ns, scan.centre_m[:, :2], H, scan.covariance_m2)


def _born(measured: Measurements, fresh: np.ndarray, first_identity: int) -> Filters:
    state, cov = np.zeros((len(fresh), 4)), np.zeros((len(fresh), 4, 4))
    state[:, :2], cov[:, :2, :2] = measured.z[fresh], measured.R[fresh]
    cov[:, 2:, 2:] = _SPEED_SIGMA_MPS**2 * np.eye(2)
    return new_filters(state, cov, first_identity + np.arange(len(fresh)), measured.stamp_ns)


def _rate_sigma(filters: Filters, row: int) -> float:
    u = lines_of_sight(filters.state[row : row + 1, :2])[0]
    return float(np.sqrt(u @ filters.cov[row, 2:, 2:] @ u))


def _track(sightings: Sequence[tuple[Scan, int, np.ndarray, float]]) -> Track:
    """Sightings as arrays; the first one has no velocity and takes the second one's."""
    scans, rows, velocities, sigmas = zip(*sightings, strict=True)
    velocity = np.pad(np.array(velocities), ((0, 0), (0, 1)))
    sigma = np.array(sigmas)
    velocity[0], sigma[0] = velocity[1], sigma[1]
    position = np.array([s.centre_m[k] for s, k in zip(scans, rows, strict=True)])
    cov = np.array([s.covariance_m2[k] for s, k in zip(scans, rows, strict=True)])
    u = lines_of_sight(position[:, :2])
    range_sigma = np.sqrt(np.einsum("ni,nij,nj->n", u, cov, u))
    frames = np.array([s.frame for s in scans])
    return Track(scans[0].drive, frames, np.array(rows), position, velocity, sigma, range_sigma, position)


_CAR_HEIGHT_M = 1.55
_BOX_RANGE_FRACTION, _BOX_BEARING_SIGMA_RAD = 0.2, np.radians(0.5)
_BORDER_PX = 6.0  # a box that ends at the image's border ends there by accident
_LEAST_HEIGHT_M = 1.45  # no road user is lower: where beams are sparse, the topmost one hits below the top
_LARGEST_M, _SMALLEST_M = 12.0, 0.3
_LOWEST_M, _HIGHEST_M = 0.5, 4.2  # of a road user's top above the ground
_STANDS_M = 0.8  # its underside is no higher: ground removal takes the lowest part
_CLUSTER_SIGMA_M = 0.5  # which part of an object the beams meet changes from frame to frame
_FAR_M = 80.0
_LEAST_WAY_M = 2.0
_LEAST_SPEED_MPS, _SPEED_SIGMAS = 2.0, 3.0
_RADAR_AGE, _RADAR_POINTS = 2, 2
_RADAR_RATE_SIGMA_MPS, _RADAR_RANGE_SIGMA_M = 0.6, 0.7
_MAX_YAW_RATE_RADPS, _YAW_STEPS = 0.4, 81
_TURN_SCALE_M = 0.6
_LEAST_CLUSTERS = 6  # to separate a turn from the standing world


def motions(observations: Sequence[Observation], prior: Prior) -> list[Motion]:
    """Ego motion at each frame: measured speed, and yaw rate from odometry or from the lidar's static clusters."""
    speeds = [_speed(o, prior) for o in observations]
    found = []
    for i, o in enumerate(observations):
        velocity = None if speeds[i] is None else (float(speeds[i] or 0.0), 0.0)
        if o.ego_yaw_rate_radps is not None:
            found.append(Motion(velocity, o.ego_yaw_rate_radps, 0.01))
            continue
        last = observations[i - 1] if i else None
        dt = 0.0 if last is None else (o.stamp_ns - last.stamp_ns) * 1e-9
        a, b = speeds[i - 1], speeds[i]
        turn = None
        if last is not None and last.drive == o.drive and 0 < dt < 2.5 and a is not None and b is not None:
            turn = turn_between(_objects(last), _objects(o), 0.5 * (a + b) * dt, dt)
        found.append(Motion(velocity) if turn is None else Motion(velocity, turn / dt, 0.02))
    return found


def turn_between(
    before_m: Float[np.ndarray, "A 3"], now_m: Float[np.ndarray, "B 3"], moved_m: float, dt_s: float
) -> float | None:
    """Rotation of the car [rad] that aligns clusters of two scans; None if there are too few.

    Centres are in the axes of their time; the car moved by `moved_m` in between.
    """
    if min(len(before_m), len(now_m)) < _LEAST_CLUSTERS:
        return None
    tree = cKDTree(now_m[:, :2])
    turns = np.linspace(-1, 1, _YAW_STEPS) * _MAX_YAW_RATE_RADPS * dt_s
    score = np.empty(len(turns))
    for k, turn in enumerate(turns):
        c, s = np.cos(turn), np.sin(turn)
        shifted = before_m[:, :2] - moved_m * np.array([np.cos(turn / 2), np.sin(turn / 2)])
        seen = shifted @ np.array([[c, -s], [s, c]])
        distance = tree.query(seen)[0]
        score[k] = np.sum(1 / (1 + (distance / _TURN_SCALE_M) ** 2))
    return float(turns[int(np.argmax(score))])


def radar_tracks(observations: Sequence[Observation]) -> list[Track]:
    """Moving clusters that perception tracked over at least two scans, with at least two detections."""
    rows: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, o in enumerate(observations):
        for k in np.flatnonzero(o.radar_track_points >= _RADAR_POINTS):
            if np.linalg.norm(o.radar_track_xyz_m[k]) < _FAR_M:
                rows.setdefault((o.drive, int(o.radar_track_id[k])), []).append((i, int(k)))
    tracks = []
    for (drive, _), seen in rows.items():
        if len(seen) < 2 or max(observations[i].radar_track_age[k] for i, k in seen) < _RADAR_AGE:
            continue
        velocity = np.array([observations[i].radar_track_velocity_mps[k] for i, k in seen], np.float64)
        if np.median(np.linalg.norm(velocity, axis=1)) < _LEAST_SPEED_MPS:
            continue
        frames, detections = (np.array(k) for k in zip(*seen, strict=True))
        position = np.array([observations[i].radar_track_xyz_m[k] for i, k in seen], np.float64)
        rate_sigma, range_sigma = (
            np.full(len(seen), sigma) for sigma in (_RADAR_RATE_SIGMA_MPS, _RADAR_RANGE_SIGMA_M)
        )
        tracks.append(Track(drive, frames, detections, position, velocity, rate_sigma, range_sigma, position))
    return tracks


def lidar_tracks(observations: Sequence[Observation], motion: Sequence[Motion]) -> list[Track]:
    """Tracks of clusters that can be road users; a sighting is the centre of a cluster's points."""
    scans, kept = [], []
    for i, o in enumerate(observations):
        rows = _road_users(o)
        kept.append(rows)
        centres = o.lidar_cluster_centre_m[rows].astype(np.float64)
        covariance = np.tile(_CLUSTER_SIGMA_M**2 * np.eye(2), (len(centres), 1, 1))
        scans.append(Scan(i, o.drive, o.stamp_ns, motion[i], centres, covariance))
    return [_renumbered(t, kept) for t in follow(scans)]


def moves_over_ground(track: Track) -> bool:
    """True if the median speed over the later half of the sightings exceeds 2 m/s and several of its sigmas."""
    later = take_rows(track, np.arange(track.sightings // 2, track.sightings))
    speed = np.median(np.linalg.norm(later.velocity_mps[:, :2], axis=1))
    return bool(speed > max(_LEAST_SPEED_MPS, _SPEED_SIGMAS * float(np.median(later.rate_sigma_mps))))


def passes_by(track: Track) -> bool:
    """True if seen in places more than 2 m apart; a static object could be any other one."""
    way_m = np.linalg.norm(track.position_m - track.position_m[0], axis=1)
    return bool(way_m.max() > _LEAST_WAY_M)


def camera_tracks(observations: Sequence[Observation], motion: Sequence[Motion]) -> list[Track]:
    """Boxes of road users, tracked in the camera's levelled axes (x forward, y left, z up)."""
    scans = []
    for i, o in enumerate(observations):
        angles, range_m = _boxes(o)
        centres = from_spherical(np.column_stack([angles, range_m]))
        along = (_BOX_RANGE_FRACTION * range_m) ** 2
        across = 0.5**2 + (_BOX_BEARING_SIGMA_RAD * range_m) ** 2
        u = np.stack([np.cos(angles[:, 0]), np.sin(angles[:, 0])], axis=-1)
        outer = u[:, :, None] * u[:, None, :]
        covariance = along[:, None, None] * outer + across[:, None, None] * (np.eye(2) - outer)
        scans.append(Scan(i, o.drive, o.camera_stamp_ns, motion[i], centres, covariance))
    return follow(scans)


def box_centres(track: Track, observations: Sequence[Observation]) -> Float[np.ndarray, "N 3"]:
    """Centre of the box around a lidar track's cluster at each sighting, extended down to the ground if known.

    The lowest part of an object is removed with the ground, and its highest part lies above the top beam. A 3D
    detector's box stands on the ground and has the usual height.
    """
    centres = np.empty((track.sightings, 3))
    for k, (i, row) in enumerate(zip(track.frame, track.detection, strict=True)):
        o = observations[i]
        low, high = (ends[row].astype(np.float64) for ends in (o.lidar_cluster_min_m, o.lidar_cluster_max_m))
        middle = 0.5 * (low + high)
        if o.ground_plane is not None:
            n, d = o.ground_plane[:3], o.ground_plane[3]
            ground = -(n[0] * middle[0] + n[1] * middle[1] + d) / n[2]
            if 0 < low[2] - ground < 1.0:
                middle[2] = 0.5 * (ground + max(high[2], ground + _LEAST_HEIGHT_M))
        centres[k] = middle
    return centres


def _speed(o: Observation, prior: Prior) -> float | None:
    if o.ego_speed_mps is not None:
        return o.ego_speed_mps
    if o.radar_velocity_mps is None:
        return None
    return float((prior.T_lidar_radar[:3, :3] @ o.radar_velocity_mps)[0])


def _objects(o: Observation) -> Float[np.ndarray, "K 3"]:
    """Centres of all clusters no larger than a lorry."""
    return o.lidar_cluster_centre_m[_no_larger_than_a_lorry(o)].astype(np.float64)


def _no_larger_than_a_lorry(o: Observation) -> Bool[np.ndarray, " K"]:
    size = np.max(o.lidar_cluster_max_m[:, :2] - o.lidar_cluster_min_m[:, :2], axis=1, initial=0.0)
    near = np.linalg.norm(o.lidar_cluster_centre_m[:, :2], axis=1) < _FAR_M
    return np.asarray((size <= _LARGEST_M) & (size >= _SMALLEST_M) & near)


def _road_users(o: Observation) -> Int64[np.ndarray, " K"]:
    """Rows of clusters that can be road users: of their size, and on the ground if it is known."""
    possible = _no_larger_than_a_lorry(o)
    if o.ground_plane is not None:
        n, d = o.ground_plane[:3], o.ground_plane[3]
        x, y, _ = o.lidar_cluster_centre_m.astype(np.float64).T
        ground = -(n[0] * x + n[1] * y + d) / n[2]
        top, bottom = o.lidar_cluster_max_m[:, 2] - ground, o.lidar_cluster_min_m[:, 2] - ground
        possible &= (bottom < _STANDS_M) & (top > _LOWEST_M) & (top < _HIGHEST_M)
    return np.flatnonzero(possible).astype(np.int64)


def _renumbered(track: Track, kept: Sequence[np.ndarray]) -> Track:
    """Detections with the cluster numbers of the observation instead of those of the tracked clusters."""
    rows = np.array([kept[i][k] for i, k in zip(track.frame, track.detection, strict=True)])
    return replace(track, detection=rows)


def _boxes(o: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] of box centres, ranges [m] from heights; boxes cut by the border are left out."""
    x0, y0, x1, y1 = o.road_user_boxes_px.astype(np.float64).reshape(-1, 4).T
    camera = camera_of(o)
    inside = (x0 > _BORDER_PX) & (y0 > _BORDER_PX)
    inside &= (x1 < o.image_width_px - _BORDER_PX) & (y1 < o.image_height_px - _BORDER_PX)
    xm, ym = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    angle = camera_direction_angles(camera.unproject(np.stack([np.stack([xm, y], -1) for y in (ym, y0, y1)])))
    height = np.array(
        [ROAD_USER_HEIGHT_M.get(name, _CAR_HEIGHT_M) for name in o.road_user_classes], np.float64
    )
    distance = height / np.maximum(angle[1, :, 1] - angle[2, :, 1], 1e-3)
    ok = inside & np.isfinite(angle).all(axis=(0, 2)) & (distance < _FAR_M)
    return angle[0, ok], distance[ok]
