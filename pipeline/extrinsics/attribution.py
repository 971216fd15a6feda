"""Which sensor moved: the one whose motion explains the shifts of all pairs.

A sensor that moves by xi in its own axes shifts the two pairs it belongs to, consistently, and leaves the
third alone:

    camera:  T_camera_lidar' = exp(-xi) T_camera_lidar    T_camera_radar' = exp(-xi) T_camera_radar
    lidar:   T_camera_lidar' = T_camera_lidar exp(xi)     T_lidar_radar'  = exp(-xi) T_lidar_radar
    radar:   T_camera_radar' = T_camera_radar exp(xi)     T_lidar_radar'  = T_lidar_radar exp(xi)

With `T exp(xi) = exp(Ad_T xi) T` each is linear in xi, so each sensor's best motion is one generalised
least squares fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import f as f_distribution

from pipeline.geometry.changes import change_jacobian
from pipeline.geometry.se3 import adjoint

__all__ = ["SENSORS", "Attribution", "PairShift", "attribute", "pair_shift"]

SENSORS = ("camera", "lidar", "radar")
_CLEAR_PROBABILITY = 0.95
# A best motion that explains the shifts worse than this is not the whole story ...
_MISFIT_PROBABILITY = 1e-3
_KNOWN = 1e9  # degrees of freedom: as good as infinitely many, for which SciPy's F has no value
_WHOLE_STORY = 0.99  # ... unless it explains this share of them (of chi-squared): sigmas are estimates


@dataclass(frozen=True, eq=False)
class PairShift:
    """Twist (left perturbation, parent axes [rad, m]) by which a pair changed, its 6x6 covariance, at `T`."""

    T: np.ndarray
    xi: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Attribution:
    """The sensor that moved and its motion (rotation vector [rad], shift [m]) in its own axes.

    `sensor` is None where the days cannot tell; `explanation` says why in words. `probability` holds each
    sensor's share against the other two, given that exactly one of them moved.
    """

    sensor: str | None
    explanation: str
    probability: dict[str, float]
    motion: np.ndarray
    covariance: np.ndarray


def pair_shift(
    origin: Float[np.ndarray, "4 4"],
    change: Float[np.ndarray, "N 6"],
    spread: Float[np.ndarray, "N 6 6"],
    is_after: Bool[np.ndarray, " N"],
    autocorrelation: float = 0.0,
) -> PairShift:
    """Shift of one pair between the days before and after a change, each side averaged by full covariances.

    Args:
        origin: T_parent_child that changes count from.
        change: of each day (rotation vector, shift of the child's origin).
        spread: covariances of the changes.
        is_after: True for days with the new value; both sides need a day.
        autocorrelation: of successive days: a mean of n of them is less sure by that.
    """
    sides = []
    for side in (~is_after, is_after):
        information = np.linalg.inv(spread[side])
        total = np.linalg.inv(information.sum(axis=0))
        mean = total @ np.einsum("nij,nj->i", information, change[side])
        sides.append((mean, total * _less_sure(int(side.sum()), autocorrelation)))
    (before, cov_before), (after, cov_after) = sides
    to_twist = np.linalg.inv(change_jacobian(origin))
    return PairShift(origin, to_twist @ (after - before), to_twist @ (cov_before + cov_after) @ to_twist.T)


def _less_sure(days: int, autocorrelation: float) -> float:
    """Variance of a mean of AR(1) days in that of independent ones."""
    lag = np.arange(1, days)
    return float(1 + 2 * np.sum((1 - lag / days) * autocorrelation**lag))


def attribute(shifts: Mapping[str, PairShift], known_by: float = np.inf) -> Attribution:
    """Decide between the three sensors.

    Args:
        shifts: by pair, of pairs whose errors are their own; at least two, else nothing can be told apart.
        known_by: degrees of freedom that the scale of the covariances is known to; inf = it is known.
    """
    pairs = tuple(shifts)
    if len(pairs) < 2:
        which = " or ".join(pairs[0].split("_")) if pairs else "any sensor"
        told = f"{which}: one pair alone has data, which both share"
        return Attribution(None, told, {}, np.zeros(6), np.eye(6))
    total = sum(float(s.xi @ np.linalg.solve(s.covariance, s.xi)) for s in shifts.values())
    fits = {sensor: _fit(sensor, {p: shifts[p] for p in pairs}) for sensor in SENSORS}
    cost = {sensor: fit[0] for sensor, fit in fits.items()}
    best = min(cost, key=cost.__getitem__)
    share = {s: float(np.exp(-0.5 * (c - cost[best]))) for s, c in cost.items()}
    probability = {s: v / sum(share.values()) for s, v in share.items()}
    motion, covariance = fits[best][1:]
    freedom = 6 * len(pairs) - 6
    if probability[best] < _CLEAR_PROBABILITY:
        rivals = [s for s in SENSORS if probability[s] > 1 - _CLEAR_PROBABILITY]
        return Attribution(None, f"cannot tell {' from '.join(rivals)}", probability, motion, covariance)
    # What is left, over a scale that the vehicle's own few days told: F, not chi-squared (Hotelling 1931).
    if (
        f_distribution.sf(cost[best] / freedom, freedom, min(known_by, _KNOWN)) < _MISFIT_PROBABILITY
        and cost[best] > (1 - _WHOLE_STORY) * total
    ):
        text = f"no single sensor explains it ({best} comes nearest): several moved, or sigmas are too small"
        return Attribution(None, text, probability, motion, covariance)
    return Attribution(best, f"the {best} moved", probability, motion, covariance)


def _fit(sensor: str, shifts: Mapping[str, PairShift]) -> tuple[float, np.ndarray, np.ndarray]:
    """Chi-squared, motion and covariance of one sensor's best motion."""
    information, moment, total = np.zeros((6, 6)), np.zeros(6), 0.0
    for pair, shift in shifts.items():
        H, W = _design(sensor, pair, shift.T), np.linalg.inv(shift.covariance)
        information += H.T @ W @ H
        moment += H.T @ W @ shift.xi
        total += float(shift.xi @ W @ shift.xi)
    covariance = np.linalg.inv(information)
    motion = covariance @ moment
    return total - float(moment @ motion), motion, covariance


def _design(sensor: str, pair: str, T: np.ndarray) -> np.ndarray:
    """d(xi of the pair)/d(motion of the sensor in its own axes)."""
    parent, child = pair.split("_")
    if sensor == child:
        return adjoint(T)
    return -np.eye(6) if sensor == parent else np.zeros((6, 6))
