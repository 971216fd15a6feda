"""Moving radar clusters followed from frame to frame, each at constant velocity over ground.

Where Doppler is ambiguous, a new track is several hypotheses, one per wrap of its range rate; the next frames
tell which one is right. Association: Hungarian assignment on gated likelihoods of position and (wrapped)
range rate.

Source: paper, section 4.2 (tracking to distinguish moving objects); Blackman, Popoli, "Design and Analysis of
Modern Tracking Systems", 1999, sections 6.2 and 4.2 (gating, Kalman filter).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.optimize import linear_sum_assignment

__all__ = ["ClusterReturns", "EgoMotion", "TrackState", "Tracks", "advance_tracks", "measure_clusters"]

_ACCELERATION_MPS2 = 2.5  # braking and turning road users
_RANGE_SIGMA_M = 0.7  # which part of a car answers changes from frame to frame
_CROSS_SIGMA_M, _AZIMUTH_SIGMA_RAD = 0.5, 0.012
_RATE_SIGMA_MPS = 0.6
_TANGENTIAL_SIGMA_MPS = 4.0  # of a new track: its Doppler says nothing across
_SPEED_SIGMA_MPS = 15.0  # prior speed of road users; weighs the Doppler wraps
_WRAPS = 3
_YAW_RATE_SIGMA_RADPS = 0.08  # where nobody measured it: gentle bends
_GATE = 11.3  # chi^2 with 3 degrees of freedom, 99 %
_FORBIDDEN = 1e6  # cost of a pair outside the gate
_PRUNE = -8.0  # log weight against the best hypothesis of the track
_MAX_GAP_S = 2.5
_MAX_MISSED_S = 1.0


@dataclass(frozen=True, eq=False)
class ClusterReturns:
    """Clusters of one scan: mean points, mean range rates over ground (modulo the period), detections."""

    centre_m: Float32[np.ndarray, "K 3"]
    rate_mps: Float32[np.ndarray, " K"]
    points: Int32[np.ndarray, " K"]


@dataclass(frozen=True)
class EgoMotion:
    """The radar's own velocity [m/s, radar frame] and yaw rate [rad/s]; None where unknown."""

    velocity_mps: tuple[float, float] | None
    yaw_rate_radps: float | None


@dataclass(frozen=True, eq=False)
class TrackState:
    """Hypotheses carried from frame to frame, row h of state (x y vx vy) belonging to track `identity[h]`."""

    stamp_ns: int | None
    drive: int
    ego: EgoMotion
    next_identity: int
    state: Float[np.ndarray, "H 4"]
    cov: Float[np.ndarray, "H 4 4"]
    log_weight: Float[np.ndarray, " H"]
    identity: Int32[np.ndarray, " H"]
    age: Int32[np.ndarray, " H"]
    seen_ns: np.ndarray

    @classmethod
    def empty(cls) -> TrackState:
        """Nothing tracked yet."""
        none = np.zeros(0, np.int32)
        return cls(
            None, -1, EgoMotion(None, None), 0, np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0), none,
            none, np.zeros(0, np.int64),
        )  # fmt: skip


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
    state: TrackState,
    stamp_ns: int,
    drive: int,
    ego: EgoMotion,
    returns: ClusterReturns,
    period_mps: float | None,
) -> tuple[TrackState, Tracks]:
    """Carry all tracks to `stamp_ns`, match the scan's clusters to them, start tracks for the others.

    A new drive, a gap above 2.5 s or an unknown ego velocity forgets all tracks: nothing links the scans
    then. Identities are never used twice.
    """
    state = _predict(state, stamp_ns, drive, ego)
    identity = _assign(state, returns, period_mps)
    fresh = np.flatnonzero(identity < 0)
    updated = [
        _update(_take(state, state.identity == i), returns, k, period_mps, stamp_ns)
        for k, i in enumerate(identity)
        if i >= 0
    ]
    born = _born(returns, fresh, period_mps, state.next_identity, stamp_ns)
    missed = ~np.isin(state.identity, identity) & (stamp_ns - state.seen_ns < _MAX_MISSED_S * 1e9)
    following = _concatenate(state, [_take(state, missed), *updated, born])
    identity[fresh] = state.next_identity + np.arange(len(fresh))
    following = replace(following, next_identity=state.next_identity + len(fresh))
    return following, _report(following, identity, returns)


def _predict(state: TrackState, stamp_ns: int, drive: int, ego: EgoMotion) -> TrackState:
    now = replace(state, stamp_ns=stamp_ns, drive=drive, ego=ego)
    dt = 0.0 if state.stamp_ns is None else (stamp_ns - state.stamp_ns) / 1e9
    before, after = state.ego.velocity_mps, ego.velocity_mps
    linked = state.drive == drive and 0 < dt <= _MAX_GAP_S and before is not None and after is not None
    if not linked or before is None or after is None:
        return _take(now, np.zeros(len(state.state), bool))
    yaw_rate, yaw_sigma = _mean_yaw_rate(state.ego, ego)
    turn = yaw_rate * dt
    moved = _rotation(turn / 2) @ ((np.array(before) + np.array(after)) / 2 * dt)
    F = np.eye(4)
    F[:2, 2:] = dt * np.eye(2)
    back = np.kron(np.eye(2), _rotation(-turn))
    x = state.state @ F.T
    x[:, :2] -= moved
    x = x @ back.T
    q = _ACCELERATION_MPS2**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
    cov = back @ (F @ state.cov @ F.T + np.kron(q, np.eye(2))) @ back.T
    across = np.concatenate([x[:, :2] @ _rotation(np.pi / 2).T, x[:, 2:] @ _rotation(np.pi / 2).T], axis=1)
    cov = cov + (yaw_sigma * dt) ** 2 * across[:, :, None] * across[:, None, :]
    return replace(now, state=x, cov=cov)


def _mean_yaw_rate(a: EgoMotion, b: EgoMotion) -> tuple[float, float]:
    known = [m.yaw_rate_radps for m in (a, b) if m.yaw_rate_radps is not None]
    return (float(np.mean(known)), 0.01) if known else (0.0, _YAW_RATE_SIGMA_RADPS)


def _assign(state: TrackState, returns: ClusterReturns, period_mps: float | None) -> np.ndarray:
    """Identity of the track that each cluster continues, -1 where it starts one."""
    result = np.full(len(returns.points), -1, np.int32)
    if not len(result) or not len(state.state):
        return result
    cost = _costs(state, returns, period_mps)
    tracks, column = np.unique(state.identity, return_inverse=True)
    best = np.stack([cost[:, column == t].min(axis=1) for t in range(len(tracks))], axis=1)
    gated = np.where(np.isfinite(best), best, _FORBIDDEN)
    for k, t in zip(*linear_sum_assignment(gated), strict=True):
        if gated[k, t] < _FORBIDDEN:
            result[k] = tracks[t]
    return result


def _costs(state: TrackState, returns: ClusterReturns, period_mps: float | None) -> np.ndarray:
    """Twice the negative log likelihood of clusters (rows) under hypotheses (columns), inf outside gates."""
    z, R = returns.centre_m[:, :2].astype(np.float64), _noise(returns.centre_m)
    H = _measurement(z)
    innovation = _innovation(z, returns.rate_mps, H, state.state, period_mps)
    S = np.einsum("kij,hjl,kml->khim", H, state.cov, H) + R[:, None]
    d2 = np.einsum("khi,khi->kh", innovation, np.linalg.solve(S, innovation[..., None])[..., 0])
    # log det S: a track that expects anything anywhere must not outbid one that expects exactly this.
    return np.where(d2 < _GATE, d2 + np.linalg.slogdet(S)[1] - 2 * state.log_weight, np.inf)


def _measurement(centre_m: np.ndarray) -> np.ndarray:
    """d(x, y, range rate)/d(x, y, vx, vy) of each cluster, its line of sight taken as known."""
    H = np.zeros((len(centre_m), 3, 4))
    H[:, 0, 0] = H[:, 1, 1] = 1.0
    H[:, 2, 2:] = centre_m / np.maximum(np.linalg.norm(centre_m, axis=1, keepdims=True), 1e-6)
    return H


def _innovation(
    centre_m: np.ndarray, rate_mps: np.ndarray, H: np.ndarray, states: np.ndarray, period_mps: float | None
) -> np.ndarray:
    """Measured minus expected (x, y, range rate) of clusters (first axis) under states (second axis)."""
    measured = np.column_stack([centre_m, rate_mps.astype(np.float64)])
    innovation = measured[:, None] - np.einsum("kij,hj->khi", H, states)
    if period_mps is not None:
        innovation[..., 2] -= period_mps * np.round(innovation[..., 2] / period_mps)
    return innovation


def _noise(centre_m: np.ndarray) -> np.ndarray:
    """Covariance of (x, y, range rate) of each cluster."""
    plane = centre_m[:, :2].astype(np.float64)
    distance = np.linalg.norm(plane, axis=1)
    u = plane / np.maximum(distance, 1e-6)[:, None]
    across = np.stack([-u[:, 1], u[:, 0]], axis=1)
    across_var = _CROSS_SIGMA_M**2 + (_AZIMUTH_SIGMA_RAD * distance) ** 2
    R = np.zeros((len(plane), 3, 3))
    R[:, :2, :2] = _RANGE_SIGMA_M**2 * _outer(u) + across_var[:, None, None] * _outer(across)
    R[:, 2, 2] = _RATE_SIGMA_MPS**2
    return R


def _outer(v: np.ndarray) -> np.ndarray:
    return v[:, :, None] * v[:, None, :]


def _update(
    track: TrackState, returns: ClusterReturns, k: int, period_mps: float | None, stamp_ns: int
) -> TrackState:
    """The hypotheses of one track after the measurement (Joseph form), without those grown unlikely."""
    z = returns.centre_m[k : k + 1, :2].astype(np.float64)
    H, R = _measurement(z)[0], _noise(z)[0]
    innovation = _innovation(z, returns.rate_mps[k : k + 1], H[None], track.state, period_mps)[0]
    S = H @ track.cov @ H.T + R
    G = np.swapaxes(np.linalg.solve(S, H @ track.cov), 1, 2)
    A = np.eye(4) - G @ H
    cov = A @ track.cov @ np.swapaxes(A, 1, 2) + G @ R @ np.swapaxes(G, 1, 2)
    d2 = np.einsum("hi,hi->h", innovation, np.linalg.solve(S, innovation[..., None])[..., 0])
    log_weight = track.log_weight - 0.5 * (d2 + np.linalg.slogdet(S)[1])
    log_weight = log_weight - log_weight.max()
    after = replace(
        track, state=track.state + np.einsum("hij,hj->hi", G, innovation), cov=cov, log_weight=log_weight,
        age=track.age + 1, seen_ns=np.full(len(d2), stamp_ns, np.int64),
    )  # fmt: skip
    return _take(after, log_weight > _PRUNE)


def _born(
    returns: ClusterReturns, fresh: np.ndarray, period_mps: float | None, first_identity: int, stamp_ns: int
) -> TrackState:
    """Hypotheses of new tracks, one per Doppler wrap."""
    wraps = np.zeros(1) if period_mps is None else period_mps * np.arange(-_WRAPS, _WRAPS + 1)
    row = np.repeat(fresh, len(wraps))
    z = returns.centre_m[row, :2].astype(np.float64)
    u = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-6)
    rate = returns.rate_mps[row] + np.tile(wraps, len(fresh))
    cov = np.zeros((len(row), 4, 4))
    cov[:, :2, :2] = _noise(z)[:, :2, :2]
    across = np.stack([-u[:, 1], u[:, 0]], axis=1)
    cov[:, 2:, 2:] = _RATE_SIGMA_MPS**2 * _outer(u) + _TANGENTIAL_SIGMA_MPS**2 * _outer(across)
    return replace(
        TrackState.empty(), state=np.concatenate([z, rate[:, None] * u], axis=1), cov=cov,
        log_weight=-0.5 * (rate / _SPEED_SIGMA_MPS) ** 2,
        identity=(first_identity + np.repeat(np.arange(len(fresh)), len(wraps))).astype(np.int32),
        age=np.ones(len(row), np.int32), seen_ns=np.full(len(row), stamp_ns, np.int64),
    )  # fmt: skip


def _report(state: TrackState, identity: np.ndarray, returns: ClusterReturns) -> Tracks:
    """The tracks seen now, in the order of the clusters, each by its most probable hypothesis."""
    order = np.lexsort((-state.log_weight, state.identity))
    rows = order[np.searchsorted(state.identity[order], identity)]
    velocity = np.zeros((len(identity), 3), np.float32)
    velocity[:, :2] = state.state[rows, 2:]
    return Tracks(returns.centre_m, velocity, identity, state.age[rows], returns.points)


def _take(state: TrackState, rows: np.ndarray) -> TrackState:
    return replace(
        state, state=state.state[rows], cov=state.cov[rows], log_weight=state.log_weight[rows],
        identity=state.identity[rows], age=state.age[rows], seen_ns=state.seen_ns[rows],
    )  # fmt: skip


def _concatenate(header: TrackState, parts: list[TrackState]) -> TrackState:
    return replace(
        header,
        state=np.concatenate([p.state for p in parts]),
        cov=np.concatenate([p.cov for p in parts]),
        log_weight=np.concatenate([p.log_weight for p in parts]),
        identity=np.concatenate([p.identity for p in parts]),
        age=np.concatenate([p.age for p in parts]),
        seen_ns=np.concatenate([p.seen_ns for p in parts]),
    )


def _rotation(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])
