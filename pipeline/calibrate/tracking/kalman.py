"""Detections of one sensor followed from frame to frame, in its own level axes (x forward, y left, z up).

No other sensor's pose is needed: the own motion between two frames comes from the car. The filter lives in
the ground plane; heights are reported as measured.

Source: Persic, Petrovic, Markovic, Petrovic, "Online multi-sensor calibration based on moving object
tracking", Advanced Robotics 35, 2021 (detection and tracking of moving objects per sensor).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.rig.ground_tracks import (
    Filters,
    Measurements,
    advance,
    carried,
    lines_of_sight,
    new_filters,
)

__all__ = ["Motion", "Scan", "Track", "follow"]

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
