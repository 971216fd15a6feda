"""Tracks of one sensor: a Kalman filter of each, and which measurement continues which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.core.rows import join_rows, take_rows
from pipeline.rig.ground_tracks import Filters, Measurements, advance, carried, lines_of_sight, new_filters
from pipeline.rig.se3 import inverse, transform_points
from pipeline.rig.spherical import to_spherical, wrap_angle

__all__ = [
    "Association",
    "Motion",
    "Scan",
    "Shared",
    "Track",
    "associate",
    "bearing_sigma_rad",
    "follow",
    "shared_sightings",
]

# --------------------------------------------------------------------------------------------------
# Detections of one sensor followed from frame to frame, in its own level axes (x forward, y left, z up).
#
# No other sensor's pose is needed: the own motion between two frames comes from the car. The filter lives in
# the ground plane; heights are reported as measured.
#
# Source: Persic, Petrovic, Markovic, Petrovic, "Online multi-sensor calibration based on moving object
# tracking", Advanced Robotics 35, 2021 (detection and tracking of moving objects per sensor).


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


# --------------------------------------------------------------------------------------------------
# Association of tracks of two sensors, mainly by their motion and last by their position.
#
# Range and range rate over ground do not depend on a sensor's rotation. Neither does the bearing as a function
# of time, up to a constant. The constant, the mean difference of the bearings, may be as large as the
# uncertainty of the prior. All are compared over the frames that both tracks share. A sighting belongs to one
# pair only. If a track of one sensor is interrupted, one track of the other sensor may have several successive
# partners.
#
# Source: Persic et al. 2021, "calibration-agnostic track to track association"; the measure is our reading of
# it.


_LEAST_SHARED = 2
_MOST_COUNTED = 8  # sightings of one track err together: a longer one is not ever more certain
_LIKENESS = 6.0  # mean squared deviation in sigmas over up to four quantities
_MOST_SQUARE = 9.0  # of one quantity in one sighting: first velocities and half-hidden boxes may be far off
_CONSTANT_SIGMAS = 3.0
_CENTRE_SIGMA_M, _ANGLE_SIGMA_RAD = 0.5, np.radians(0.5)  # the sensors mean different points of one object
_RANGE_OFFSET_SIGMA_M = 1.0  # near side against centre


@dataclass(frozen=True, eq=False)
class Association:
    """Pairs of tracks (rows of the reference's and of the other sensor's), and their shared sightings."""

    reference: Int64[np.ndarray, " K"]
    other: Int64[np.ndarray, " K"]
    sightings: Int64[np.ndarray, " S"]  # rows of `Shared.of_reference`, pair by pair
    pair: Int64[np.ndarray, " S"]  # 0..K-1


@dataclass(frozen=True, eq=False)
class Shared:
    """Sightings in common frames of all pairs of tracks with at least two such frames, one pair after the other."""

    reference: Int64[np.ndarray, " P"]
    other: Int64[np.ndarray, " P"]
    first: Int64[np.ndarray, " P"]  # of each pair's sightings
    count: Int64[np.ndarray, " P"]
    of_reference: Track  # S sightings each, row by row of the same frame
    of_other: Track


def associate(
    shared: Shared,
    T_other_reference: Float[np.ndarray, "4 4"],
    rotation_sigma_rad: float,
    *,
    elevation: bool = True,
) -> Association:
    """Pair tracks inside the gates, best scores first; a pair must not use a sighting of a better pair.

    Args:
        shared: sightings by the reference and the other sensor in common frames, in levelled axes.
        elevation: False if one of the two does not measure elevation.
    """
    kept = np.zeros(0, np.int64)
    if len(shared.first):
        score = _scores(shared, T_other_reference, rotation_sigma_rad, elevation=elevation)
        kept = _without_conflict(shared, score)
    pair = np.repeat(np.arange(len(shared.first)), shared.count)
    sightings = np.flatnonzero(np.isin(pair, kept))
    return Association(
        shared.reference[kept], shared.other[kept], sightings, np.searchsorted(kept, pair[sightings])
    )


def shared_sightings(reference: Sequence[Track], other: Sequence[Track]) -> Shared:
    """All pairs of tracks of one drive with at least two common frames."""
    rows = [(i, k, t.drive, int(f)) for i, t in enumerate(reference) for k, f in enumerate(t.frame)]
    at: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for j, t in enumerate(other):
        for k, f in enumerate(t.frame):
            at.setdefault((t.drive, int(f)), []).append((j, k))
    joined = np.array(
        sorted((i, j, k, m) for i, k, drive, f in rows for j, m in at.get((drive, f), ())), np.int64
    ).reshape(-1, 4)
    _, first, count = np.unique(joined[:, :2], axis=0, return_index=True, return_counts=True)
    often = count >= _LEAST_SHARED
    joined = joined[np.repeat(often, count)]
    count = count[often].astype(np.int64)
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64) if len(count) else count
    return Shared(
        joined[first, 0],
        joined[first, 1],
        first,
        count,
        _gathered(reference, joined[:, 0], joined[:, 2]),
        _gathered(other, joined[:, 1], joined[:, 3]),
    )


def bearing_sigma_rad(range_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Sigma of the difference of two sensors' bearings to one object: half a metre and half a degree."""
    return np.hypot(_ANGLE_SIGMA_RAD, _CENTRE_SIGMA_M / np.maximum(range_m, 1.0))


def _without_conflict(shared: Shared, score: Float[np.ndarray, " P"]) -> Int64[np.ndarray, " K"]:
    """The best pairs first; further pairs of a track must not share its sightings."""
    taken: set[tuple[int, int, int]] = set()
    kept = []
    for k in np.argsort(-score, kind="stable"):
        if score[k] <= 0:
            break
        rows = slice(shared.first[k], shared.first[k] + shared.count[k])
        claims = {
            (side, int(track), int(f))
            for side, track in enumerate((shared.reference[k], shared.other[k]))
            for f in shared.of_reference.frame[rows]
        }
        if taken.isdisjoint(claims):
            taken |= claims
            kept.append(int(k))
    return np.array(sorted(kept), np.int64)


def _scores(
    shared: Shared, T_b_a: np.ndarray, rotation_sigma_rad: float, *, elevation: bool
) -> Float[np.ndarray, " P"]:
    """Evidence that each pair of tracks is one object; 0 outside the gates.

    It is the margin between the gate and the mean squared deviation, times the sightings, minus the square of
    the constant.
    """
    a, b, first, count = shared.of_reference, shared.of_other, shared.first, shared.count
    expected = to_spherical(transform_points(T_b_a, a.position_m))
    seen = to_spherical(b.position_m)
    sigma = bearing_sigma_rad(seen[:, 2])
    axes = 2 if elevation else 1
    gap = wrap_angle(seen[:, :axes] - expected[:, :axes])
    constant = np.stack([_medians(gap[:, k], first, count) for k in range(axes)], axis=1)
    # Ranges about the other sensor's origin and range rates along its line of sight: no rotation enters.
    rate_a = _along(a.velocity_mps, a.position_m - inverse(T_b_a)[:3, 3])
    rate_b = _along(b.velocity_mps, b.position_m)
    range_var = a.range_sigma_m**2 + b.range_sigma_m**2 + _RANGE_OFFSET_SIGMA_M**2
    rate_var = a.rate_sigma_mps**2 + b.rate_sigma_mps**2
    squares = np.column_stack(
        [
            (seen[:, 2] - expected[:, 2]) ** 2 / range_var,
            (rate_b - rate_a) ** 2 / rate_var,
            ((gap - np.repeat(constant, count, axis=0)) / sigma[:, None]) ** 2,
        ]
    )
    deviation = np.minimum(squares, _MOST_SQUARE).sum(axis=1)
    left = _LIKENESS - np.add.reduceat(deviation, first) / count
    typical = _medians(sigma, first, count)
    constant_square = np.sum(constant**2, axis=1) / (rotation_sigma_rad**2 + typical**2)
    inside = (left > 0) & (constant_square < _CONSTANT_SIGMAS**2 * axes)
    return np.where(inside, np.maximum(np.minimum(count, _MOST_COUNTED) * left - constant_square, 0.0), 0.0)


def _medians(value: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Median of each segment of values."""
    ordered = value[np.lexsort((value, np.repeat(np.arange(len(first)), count)))]
    return 0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2])


def _along(velocity: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.sum(velocity * direction, axis=1) / np.maximum(np.linalg.norm(direction, axis=1), 1e-6)


def _gathered(tracks: Sequence[Track], track: np.ndarray, row: np.ndarray) -> Track:
    """The named sightings of many tracks in one, in the order named."""
    if not tracks:
        none, nothing = np.zeros(0, np.int64), np.zeros(0)
        return Track(-1, none, none, np.zeros((0, 3)), np.zeros((0, 3)), nothing, nothing, np.zeros((0, 3)))
    start = np.concatenate([[0], np.cumsum([t.sightings for t in tracks])[:-1]]).astype(np.int64)
    return take_rows(join_rows(tracks), start[track] + row)
