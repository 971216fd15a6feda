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
from jaxtyping import Float
from scipy.stats import chi2

from pipeline.geometry.se3 import adjoint, inverse, log_se3

__all__ = ["SENSORS", "Attribution", "PairShift", "attribute", "independent_pairs", "pair_shift"]

SENSORS = ("camera", "lidar", "radar")
_CLEAR_PROBABILITY = 0.95
_MISFIT_PROBABILITY = 1e-3  # a best motion that explains the shifts worse than this is not the whole story


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
    T: Float[np.ndarray, "N 4 4"], covariance: Float[np.ndarray, "N 6 6"], is_after: np.ndarray
) -> PairShift:
    """Shift of one pair between the days before and after a change, each side averaged by full covariances.

    Args:
        T: day estimates of T_parent_child.
        covariance: theirs, of left perturbations.
        is_after: True for days with the new value; both sides need a day.
    """
    reference = T[0]
    xi = np.stack([log_se3(T_day @ inverse(reference)) for T_day in T])
    sides = []
    for side in (~is_after, is_after):
        information = np.linalg.inv(covariance[side])
        total = np.linalg.inv(information.sum(axis=0))
        sides.append((total @ np.einsum("nij,nj->i", information, xi[side]), total))
    (before, cov_before), (after, cov_after) = sides
    return PairShift(reference, after - before, cov_before + cov_after)


def independent_pairs(shifts: Mapping[str, PairShift], *, closure: float = 1e-6) -> tuple[str, ...]:
    """Pairs whose errors are their own: camera_radar is left out where it is composed of the other two."""
    if len(shifts) < 3:
        return tuple(shifts)
    T_cl, T_lr, T_cr = (shifts[p].T for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    is_composed = np.abs(T_cl @ T_lr - T_cr).max() < closure
    return ("camera_lidar", "lidar_radar") if is_composed else tuple(shifts)


def attribute(shifts: Mapping[str, PairShift]) -> Attribution:
    """Decide between the three sensors.

    Args:
        shifts: by pair; at least two pairs, else nothing can be told apart.
    """
    pairs = independent_pairs(shifts)
    if len(pairs) < 2:
        return Attribution(
            None, "only one pair has data, which two sensors share", {}, np.zeros(6), np.eye(6)
        )
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
    if chi2.sf(cost[best], freedom) < _MISFIT_PROBABILITY:
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
