"""Detections of one sensor followed from frame to frame: Kalman filter at constant velocity, Hungarian assignment.

Each sensor tracks in its own level axes (x forward, y left, z up) and needs no other sensor's pose: the own
motion between two frames comes from the car. The filter lives in the ground plane; heights are reported as
measured.

Source: Persic, Petrovic, Markovic, Petrovic, "Online multi-sensor calibration based on moving object tracking",
Advanced Robotics 35, 2021 (detection and tracking of moving objects per sensor); Blackman, Popoli, "Design and
Analysis of Modern Tracking Systems", 1999, sections 4.2, 6.2 and 6.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.optimize import linear_sum_assignment

__all__ = ["Motion", "Scan", "Track", "follow", "take_sightings"]

_ACCELERATION_MPS2 = 2.5  # braking and turning road users
_SPEED_SIGMA_MPS = 15.0  # of a new track, over ground, about standing still
_GATE = 9.2  # chi^2 with 2 degrees of freedom, 99 %
_FORBIDDEN = 1e6
_MAX_GAP_S, _MAX_MISSED_S = 2.5, 1.5


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
    stamp_s: float
    motion: Motion
    centre_m: Float[np.ndarray, "K 3"]
    covariance_m2: Float[np.ndarray, "K 2 2"]


@dataclass(frozen=True, eq=False)
class Track:
    """One object as one sensor saw it: a row per sighting, in the sensor's level axes, velocity over ground."""

    drive: int
    frame: Int64[np.ndarray, " N"]  # index into the observations
    detection: Int64[np.ndarray, " N"]  # index within the frame
    stamp_s: Float[np.ndarray, " N"]
    position_m: Float[np.ndarray, "N 3"]
    velocity_mps: Float[np.ndarray, "N 3"]
    rate_sigma_mps: Float[np.ndarray, " N"]  # of the velocity along the line of sight
    range_sigma_m: Float[np.ndarray, " N"]

    @property
    def sightings(self) -> int:
        """Number of frames that it was seen in."""
        return len(self.frame)


@dataclass
class _Live:
    """Filters of the tracks that can still be continued; rows of state are x y vx vy."""

    state: np.ndarray
    cov: np.ndarray
    identity: np.ndarray
    seen_s: np.ndarray

    def take(self, rows: np.ndarray) -> _Live:
        return _Live(self.state[rows], self.cov[rows], self.identity[rows], self.seen_s[rows])


def follow(scans: Sequence[Scan]) -> list[Track]:
    """Tracks of at least two sightings; a new drive, a gap above 2.5 s or unknown own motion ends all of them.

    Args:
        scans: in order of time.

    Returns:
        Tracks in order of their first sighting. Positions are the measured ones, without the filter's lag.
    """
    live = _none()
    sightings: list[list[tuple[int, int, np.ndarray, float]]] = []
    before: Scan | None = None
    for index, scan in enumerate(scans):
        live = _predicted(live, before, scan)
        matched, found = _matched(live, scan)
        updated = _updated(live.take(matched), scan, found)
        fresh = np.setdiff1d(np.arange(len(scan.centre_m)), found)
        born = _born(scan, fresh, len(sightings))
        sightings += [[] for _ in fresh]
        for part, rows in ((updated, found), (born, fresh)):
            for k, row in enumerate(rows):
                sigma = _rate_sigma(part.state[k], part.cov[k])
                sightings[part.identity[k]].append((index, int(row), part.state[k, 2:].copy(), sigma))
        missed = np.setdiff1d(np.arange(len(live.identity)), matched)
        missed = missed[scan.stamp_s - live.seen_s[missed] < _MAX_MISSED_S]
        live = _joined([updated, live.take(missed), born])
        before = scan
    return [_track(scans, s) for s in sightings if len(s) > 1]


def take_sightings(track: Track, rows: np.ndarray) -> Track:
    """The track with only some of its sightings."""
    return Track(
        track.drive, track.frame[rows], track.detection[rows], track.stamp_s[rows], track.position_m[rows],
        track.velocity_mps[rows], track.rate_sigma_mps[rows], track.range_sigma_m[rows],
    )  # fmt: skip


def _none() -> _Live:
    return _Live(np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0, np.int64), np.zeros(0))


def _joined(parts: Sequence[_Live]) -> _Live:
    return _Live(
        np.concatenate([p.state for p in parts]), np.concatenate([p.cov for p in parts]),
        np.concatenate([p.identity for p in parts]), np.concatenate([p.seen_s for p in parts]),
    )  # fmt: skip


def _predicted(live: _Live, before: Scan | None, scan: Scan) -> _Live:
    """Carried to the scan's time and into the axes that the sensor has then."""
    if before is None or before.drive != scan.drive:
        return _none()
    dt = scan.stamp_s - before.stamp_s
    a, b = before.motion.velocity_mps, scan.motion.velocity_mps
    if not 0 < dt <= _MAX_GAP_S or a is None or b is None:
        return _none()
    turn = 0.5 * (before.motion.yaw_rate_radps + scan.motion.yaw_rate_radps) * dt
    turn_sigma = max(before.motion.yaw_rate_sigma_radps, scan.motion.yaw_rate_sigma_radps) * dt
    moved = _rotation(turn / 2) @ (0.5 * (np.array(a) + np.array(b)) * dt)
    F, back = np.eye(4), np.kron(np.eye(2), _rotation(-turn))
    F[:2, 2:] = dt * np.eye(2)
    x = live.state @ F.T
    x[:, :2] -= moved
    x = x @ back.T
    q = _ACCELERATION_MPS2**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
    cov = back @ (F @ live.cov @ F.T + np.kron(q, np.eye(2))) @ back.T
    across = np.stack([-x[:, 1], x[:, 0], -x[:, 3], x[:, 2]], axis=1)
    cov = cov + turn_sigma**2 * across[:, :, None] * across[:, None, :]
    return _Live(x, cov, live.identity, live.seen_s)


def _matched(live: _Live, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `live` and the detections that continue them."""
    none = np.zeros(0, np.int64)
    if not len(live.identity) or not len(scan.centre_m):
        return none, none
    gap = scan.centre_m[None, :, :2] - live.state[:, None, :2]
    S = live.cov[:, None, :2, :2] + scan.covariance_m2[None]
    d2 = np.einsum("hki,hki->hk", gap, np.linalg.solve(S, gap[..., None])[..., 0])
    # log det S: a track that expects anything anywhere must not outbid one that expects exactly this.
    cost = np.where(d2 < _GATE, d2 + np.linalg.slogdet(S)[1], _FORBIDDEN)
    rows, columns = linear_sum_assignment(cost)
    kept = cost[rows, columns] < _FORBIDDEN
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)


def _updated(live: _Live, scan: Scan, found: np.ndarray) -> _Live:
    """After the measurement (Joseph form)."""
    R = scan.covariance_m2[found]
    S = live.cov[:, :2, :2] + R
    G = np.swapaxes(np.linalg.solve(S, live.cov[:, :2, :]), 1, 2)
    x = live.state + np.einsum("hij,hj->hi", G, scan.centre_m[found, :2] - live.state[:, :2])
    A = np.eye(4) - np.concatenate([G, np.zeros_like(G)], axis=2)
    cov = A @ live.cov @ np.swapaxes(A, 1, 2) + G @ R @ np.swapaxes(G, 1, 2)
    return _Live(x, cov, live.identity, np.full(len(x), scan.stamp_s))


def _born(scan: Scan, fresh: np.ndarray, first: int) -> _Live:
    state, cov = np.zeros((len(fresh), 4)), np.zeros((len(fresh), 4, 4))
    state[:, :2] = scan.centre_m[fresh, :2]
    cov[:, :2, :2] = scan.covariance_m2[fresh]
    cov[:, 2:, 2:] = _SPEED_SIGMA_MPS**2 * np.eye(2)
    return _Live(state, cov, first + np.arange(len(fresh)), np.full(len(fresh), scan.stamp_s))


def _rate_sigma(state: np.ndarray, cov: np.ndarray) -> float:
    u = state[:2] / max(float(np.linalg.norm(state[:2])), 1e-6)
    return float(np.sqrt(u @ cov[2:, 2:] @ u))


def _track(scans: Sequence[Scan], sightings: Sequence[tuple[int, int, np.ndarray, float]]) -> Track:
    """Sightings as arrays; the first one takes the second one's velocity, for it had none of its own."""
    members = [scans[i] for i, _, _, _ in sightings]
    rows = np.array([k for _, k, _, _ in sightings])
    velocity = np.zeros((len(rows), 3))
    velocity[:, :2] = [v for _, _, v, _ in sightings]
    sigma = np.array([s for _, _, _, s in sightings])
    velocity[0], sigma[0] = velocity[1], sigma[1]
    position = np.array([s.centre_m[k] for s, k in zip(members, rows, strict=True)])
    cov = np.array([s.covariance_m2[k] for s, k in zip(members, rows, strict=True)])
    u = position[:, :2] / np.maximum(np.linalg.norm(position[:, :2], axis=1, keepdims=True), 1e-6)
    return Track(
        members[0].drive, np.array([s.frame for s in members]), rows, np.array([s.stamp_s for s in members]),
        position, velocity, sigma, np.sqrt(np.einsum("ni,nij,nj->n", u, cov, u)),
    )  # fmt: skip


def _rotation(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])
