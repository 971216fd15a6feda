"""Object tracking in the ground plane: Kalman filters with constant velocity, Hungarian assignment.

The sensor moves; states are in its current level axes (x forward, y left, z up). An object may have several
hypotheses; those with likelier measurements gain weight.

Source: Blackman, Popoli, "Design and Analysis of Modern Tracking Systems", 1999, sections 4.2, 6.2 and 6.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from pipeline.core.rows import join_rows, take_rows

__all__ = ["Filters", "Measurements", "advance", "carried", "lines_of_sight", "new_filters", "outer"]

_ACCELERATION_MPS2 = 2.5  # braking and turning road users
_MAX_GAP_S = 2.5
_FORBIDDEN = 1e6  # cost of a pair outside the gate
_PRUNE = -8.0  # log weight relative to the best hypothesis of the object


@dataclass(frozen=True, eq=False)
class Filters:
    """Hypotheses: row h has state (x y vx vy, velocity over ground) and belongs to object `identity[h]`."""

    state: Float[np.ndarray, "H 4"]
    cov: Float[np.ndarray, "H 4 4"]
    log_weight: Float[np.ndarray, " H"]
    identity: Int[np.ndarray, " H"]
    age: Int[np.ndarray, " H"]  # sightings
    seen_ns: Int[np.ndarray, " H"]  # last sighting

    @classmethod
    def none(cls) -> Filters:
        """Filters without objects."""
        return new_filters(np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0, np.int32), 0)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of K objects in a scan: z = H state + noise with covariance R."""

    stamp_ns: int
    z: Float[np.ndarray, "K M"]
    H: Float[np.ndarray, "K M 4"]
    R: Float[np.ndarray, "K M M"]
    period: float | None = None  # of the last component, if it is ambiguous

    def innovation(self, k: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Measurements k minus predictions from states; the two broadcast."""
        found = self.z[k] - np.einsum("...ij,...j->...i", self.H[k], state)
        if self.period is not None:
            found[..., -1] -= self.period * np.round(found[..., -1] / self.period)
        return found


def new_filters(state: np.ndarray, cov: np.ndarray, identity: np.ndarray, stamp_ns: int) -> Filters:
    """New filters, after their first measurement."""
    once, stamps = np.ones(len(identity), np.int32), np.full(len(identity), stamp_ns)
    return Filters(state, cov, np.zeros(len(identity)), identity.astype(np.int32), once, stamps)


def carried(
    filters: Filters,
    dt_s: float,
    velocities_mps: tuple[tuple[float, float] | None, tuple[float, float] | None],
    yaw_rate: tuple[float, float],
) -> Filters:
    """Filters predicted over `dt_s`, in the sensor's axes then; none after a gap or without velocities.

    `velocities_mps` are the sensor's at both scans, in its axes; `yaw_rate` has mean and sigma [rad/s].
    """
    before, after = velocities_mps
    if not 0 < dt_s <= _MAX_GAP_S or before is None or after is None:
        return Filters.none()
    turn = yaw_rate[0] * dt_s
    moved = _rotation(turn / 2) @ ((np.array(before) + np.array(after)) / 2 * dt_s)
    F, back = np.eye(4), np.kron(np.eye(2), _rotation(-turn))
    F[:2, 2:] = dt_s * np.eye(2)
    x = filters.state @ F.T
    x[:, :2] -= moved
    x = x @ back.T
    q = _ACCELERATION_MPS2**2 * np.array([[dt_s**4 / 4, dt_s**3 / 2], [dt_s**3 / 2, dt_s**2]])
    cov = back @ (F @ filters.cov @ F.T + np.kron(q, np.eye(2))) @ back.T
    across = np.stack([-x[:, 1], x[:, 0], -x[:, 3], x[:, 2]], axis=1)
    return replace(filters, state=x, cov=cov + (yaw_rate[1] * dt_s) ** 2 * outer(across))


def advance(
    filters: Filters, measured: Measurements, born: Callable[[Measurements, np.ndarray, int], Filters],
    first_identity: int, gate: float, missed_s: float,
) -> tuple[Filters, Int[np.ndarray, " K"]]:  # fmt: skip
    """Assign measurements to filters predicted to the scan; `born` makes filters from the unassigned ones.

    New identities start at `first_identity`. A match is within `gate` (squared distance in sigmas); an object
    is dropped after `missed_s` without measurements.

    Returns:
        Filters after the scan, and the identity of each measurement.
    """
    identity = _matched(filters, measured, gate)
    fresh = np.flatnonzero(identity < 0)
    number = {int(i): k for k, i in enumerate(identity) if i >= 0}
    seen = np.isin(filters.identity, identity)
    updated = _updated(
        take_rows(filters, seen), measured, np.array([number[int(i)] for i in filters.identity[seen]], int)
    )
    missed = ~seen & (measured.stamp_ns - filters.seen_ns < missed_s * 1e9)
    following = join_rows([take_rows(filters, missed), updated, born(measured, fresh, first_identity)])
    identity[fresh] = first_identity + np.arange(len(fresh))
    return following, identity


def lines_of_sight(points_m: np.ndarray) -> np.ndarray:
    """Unit vectors to points; zero for the origin."""
    return points_m / np.maximum(np.linalg.norm(points_m, axis=1, keepdims=True), 1e-6)


def outer(v: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N D D"]:
    """Outer product of each vector with itself."""
    return v[:, :, None] * v[:, None, :]


def _matched(filters: Filters, measured: Measurements, gate: float) -> np.ndarray:
    """Identity of the assigned object per measurement, -1 for a new object."""
    identity = np.full(len(measured.z), -1, np.int32)
    if not len(identity) or not len(filters.identity):
        return identity
    every = np.arange(len(identity))[:, None]
    innovation = measured.innovation(every, filters.state[None])
    H = measured.H[:, None]
    S = H @ filters.cov @ np.swapaxes(H, 2, 3) + measured.R[:, None]
    d2 = np.einsum("khi,khi->kh", innovation, np.linalg.solve(S, innovation[..., None])[..., 0])
    # log det S: penalises tracks with a large predicted covariance.
    cost = np.where(d2 < gate, d2 + np.linalg.slogdet(S)[1] - 2 * filters.log_weight, _FORBIDDEN)
    objects, column = np.unique(filters.identity, return_inverse=True)
    best = np.full((len(identity), len(objects)), _FORBIDDEN)
    np.minimum.at(best, (every, column[None]), cost)
    for k, t in zip(*linear_sum_assignment(best), strict=True):
        if best[k, t] < _FORBIDDEN:
            identity[k] = objects[t]
    return identity


def _updated(filters: Filters, measured: Measurements, k: np.ndarray) -> Filters:
    """Filters updated with measurements k (Joseph form), without unlikely hypotheses."""
    H, R, P = measured.H[k], measured.R[k], filters.cov
    innovation = measured.innovation(k, filters.state)
    S = H @ P @ np.swapaxes(H, 1, 2) + R
    G = np.swapaxes(np.linalg.solve(S, H @ P), 1, 2)
    A = np.eye(4) - G @ H
    d2 = np.einsum("hi,hi->h", innovation, np.linalg.solve(S, innovation[..., None])[..., 0])
    weight = filters.log_weight - 0.5 * (d2 + np.linalg.slogdet(S)[1])
    most = np.full(len(measured.z), -np.inf)
    np.maximum.at(most, k, weight)
    after = replace(
        filters,
        state=filters.state + np.einsum("hij,hj->hi", G, innovation),
        cov=A @ P @ np.swapaxes(A, 1, 2) + G @ R @ np.swapaxes(G, 1, 2),
        log_weight=weight - most[k],
        age=filters.age + 1,
        seen_ns=np.full(len(k), measured.stamp_ns),
    )
    return take_rows(after, after.log_weight > _PRUNE)


def _rotation(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])
