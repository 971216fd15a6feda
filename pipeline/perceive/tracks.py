"""Moving radar clusters tracked over frames, each at constant velocity over ground.

If Doppler is ambiguous, a new track has several hypotheses, one per wrap of its range rate; the next frames
decide. Association is on gated likelihoods of position and (wrapped) range rate.

Source: paper, section 4.2 (tracking to distinguish moving objects).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Int32

from pipeline.rig.ground_tracks import (
    Filters,
    Measurements,
    advance,
    carried,
    lines_of_sight,
    new_filters,
    outer,
)

__all__ = ["ClusterReturns", "EgoMotion", "TrackState", "Tracks", "advance_tracks", "measure_clusters"]

_RANGE_SIGMA_M = 0.7  # which part of a car answers changes from frame to frame
_CROSS_SIGMA_M, _AZIMUTH_SIGMA_RAD = 0.5, 0.012
_RATE_SIGMA_MPS = 0.6
_TANGENTIAL_SIGMA_MPS = 4.0  # of a new track: its Doppler says nothing across
_SPEED_SIGMA_MPS = 15.0  # prior speed of road users; weighs the Doppler wraps
_WRAPS = 3
_YAW_RATE_SIGMA_RADPS = 0.08  # where nobody measured it: gentle bends
_GATE, _MAX_MISSED_S = 11.3, 1.0  # chi^2 with 3 degrees of freedom, 99 %


@dataclass(frozen=True, eq=False)
class ClusterReturns:
    """Clusters of one scan: mean points, mean range rates over ground (modulo the period), detections."""

    centre_m: Float32[np.ndarray, "K 3"]
    rate_mps: Float32[np.ndarray, " K"]
    points: Int32[np.ndarray, " K"]


@dataclass(frozen=True)
class EgoMotion:
    """The radar's own velocity [m/s, radar frame] and yaw rate [rad/s]; None if unknown."""

    velocity_mps: tuple[float, float] | None
    yaw_rate_radps: float | None


@dataclass(frozen=True, eq=False)
class TrackState:
    """State between frames; by default nothing is tracked yet."""

    stamp_ns: int | None = None
    drive: int = -1
    ego: EgoMotion = EgoMotion(None, None)
    next_identity: int = 0
    filters: Filters = field(default_factory=Filters.none)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of one scan: measured centres (no filter lag), filtered velocities over ground, radar axes."""

    xyz_m: Float32[np.ndarray, "K 3"]
    velocity_mps: Float32[np.ndarray, "K 3"]
    identity: Int32[np.ndarray, " K"]
    age: Int32[np.ndarray, " K"]
    points: Int32[np.ndarray, " K"]


def measure_clusters(
    xyz_m: Float32[np.ndarray, "M 3"],
    residual_mps: Float32[np.ndarray, " M"],
    cluster: Int32[np.ndarray, " M"],
    period_mps: float | None,
) -> ClusterReturns:
    """Mean point and (circular) mean range rate over ground of each cluster 0..K-1."""
    rows = np.flatnonzero(cluster >= 0)
    label, rate = cluster[rows], residual_mps[rows].astype(np.float64)
    count = np.bincount(label)
    safe = np.maximum(count, 1)
    centre = np.stack([np.bincount(label, xyz_m[rows, k]) for k in range(3)], axis=1) / safe[:, None]
    if period_mps is None:
        mean = np.bincount(label, rate) / safe
    else:
        phase = np.bincount(label, np.sin(w := 2 * np.pi * rate / period_mps)), np.bincount(label, np.cos(w))
        mean = np.arctan2(*phase) * period_mps / (2 * np.pi)
    kept = count > 0
    return ClusterReturns(
        centre[kept].astype(np.float32), mean[kept].astype(np.float32), count[kept].astype(np.int32)
    )


def advance_tracks(
    state: TrackState, stamp_ns: int, drive: int, ego: EgoMotion, returns: ClusterReturns,
    period_mps: float | None,
) -> tuple[TrackState, Tracks]:  # fmt: skip
    """Predict all tracks to `stamp_ns`, match the scan's clusters to them, start tracks for the others.

    A new drive, a gap above 2.5 s or an unknown ego velocity deletes all tracks, because nothing links the
    scans then. Identities are never used twice.
    """
    filters = Filters.none()
    if state.stamp_ns is not None and state.drive == drive:
        velocities = (state.ego.velocity_mps, ego.velocity_mps)
        dt_s = (stamp_ns - state.stamp_ns) / 1e9
        rates = [m.yaw_rate_radps for m in (state.ego, ego) if m.yaw_rate_radps is not None]
        yaw_rate = (float(np.mean(rates)), 0.01) if rates else (0.0, _YAW_RATE_SIGMA_RADPS)
        filters = carried(state.filters, dt_s, velocities, yaw_rate)
    measured = _measured(returns, stamp_ns, period_mps)
    filters, identity = advance(filters, measured, _born, state.next_identity, _GATE, _MAX_MISSED_S)
    following = max(state.next_identity, int(identity.max(initial=-1)) + 1)
    return TrackState(stamp_ns, drive, ego, following, filters), _report(filters, identity, returns)


def _measured(returns: ClusterReturns, stamp_ns: int, period_mps: float | None) -> Measurements:
    """Position and range rate of each cluster, with an exact line of sight."""
    centre = returns.centre_m.astype(np.float64)
    plane, distance = centre[:, :2], np.linalg.norm(centre[:, :2], axis=1)
    u = lines_of_sight(plane)
    across_var = _CROSS_SIGMA_M**2 + (_AZIMUTH_SIGMA_RAD * distance) ** 2
    R, H = np.zeros((len(plane), 3, 3)), np.zeros((len(plane), 3, 4))
    R[:, :2, :2] = _RANGE_SIGMA_M**2 * outer(u) + across_var[:, None, None] * outer(_across(u))
    R[:, 2, 2] = _RATE_SIGMA_MPS**2
    H[:, 0, 0] = H[:, 1, 1] = 1.0
    H[:, 2, 2:] = u
    return Measurements(stamp_ns, np.column_stack([plane, returns.rate_mps]), H, R, period_mps)


def _born(measured: Measurements, fresh: np.ndarray, first_identity: int) -> Filters:
    """Hypotheses of new tracks, one per Doppler wrap."""
    period = measured.period
    wraps = np.zeros(1) if period is None else period * np.arange(-_WRAPS, _WRAPS + 1)
    row = np.repeat(fresh, len(wraps))
    z, u = measured.z[row, :2], measured.H[row, 2, 2:]
    rate = measured.z[row, 2] + np.tile(wraps, len(fresh))
    cov = np.zeros((len(row), 4, 4))
    cov[:, :2, :2] = measured.R[row, :2, :2]
    cov[:, 2:, 2:] = _RATE_SIGMA_MPS**2 * outer(u) + _TANGENTIAL_SIGMA_MPS**2 * outer(_across(u))
    identity = first_identity + np.repeat(np.arange(len(fresh)), len(wraps))
    state = np.concatenate([z, rate[:, None] * u], axis=1)
    weight = -0.5 * (rate / _SPEED_SIGMA_MPS) ** 2
    return replace(new_filters(state, cov, identity, measured.stamp_ns), log_weight=weight)


def _across(u: np.ndarray) -> np.ndarray:
    """Unit vectors rotated by 90 deg to the left."""
    return np.stack([-u[:, 1], u[:, 0]], axis=1)


def _report(filters: Filters, identity: np.ndarray, returns: ClusterReturns) -> Tracks:
    """The tracks seen now, in the order of the clusters, each by its most probable hypothesis."""
    order = np.lexsort((-filters.log_weight, filters.identity))
    rows = order[np.searchsorted(filters.identity[order], identity)]
    velocity = np.zeros((len(identity), 3), np.float32)
    velocity[:, :2] = filters.state[rows, 2:]
    return Tracks(returns.centre_m, velocity, identity, filters.age[rows], returns.points)
