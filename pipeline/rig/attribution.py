"""Attribution of edge changes to the sensor that moved.

A sensor that moves by xi in its own axes changes the edges at which it is an end, consistently, and no
others:

    its edges as parent:  T_sensor_other' = exp(-xi) T_sensor_other
    its edges as child:   T_other_sensor' = T_other_sensor exp(xi)

With `T exp(xi) = exp(Ad_T xi) T` each change is linear in xi, so the best motion of each sensor is one
generalised least squares fit. A sensor with a single edge is distinguished from its neighbour by the
neighbour's other edges, which do not change. The vehicle frame is a node like the others: if `base` moved,
all sensors moved relative to the road.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from pipeline.rig.graph import KINDS, Edge
from pipeline.rig.se3 import adjoint

__all__ = ["Attribution", "Moved", "PairShift", "attribute"]

_Who = TypeVar("_Who", str, tuple[str, str])
_CLEAR_PROBABILITY = 0.95
# A best motion with a smaller probability of its residual does not explain the changes ...
_MISFIT_PROBABILITY = 1e-3
_KNOWN = 1e9  # degrees of freedom treated as infinite, for which SciPy's F has no value
_WHOLE_STORY = 0.99  # ... unless it explains this share of their chi-squared: sigmas are estimates
# With three sensors, any two moving against the third explain every change: pairs need more than three.
_FEWEST_FOR_TWO = 4


@dataclass(frozen=True, eq=False)
class PairShift:
    """Change of an edge as twist (left perturbation, parent axes [rad, m]), 6x6 covariance, and T."""

    T: np.ndarray
    xi: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class _Weighed:
    """A change with precomputed parts of every fit: its weight, its weighted value, and the adjoint of T."""

    xi: np.ndarray
    W: np.ndarray
    square: float
    adjoint: np.ndarray

    @classmethod
    def of(cls, shift: PairShift) -> _Weighed:
        W = np.linalg.inv(shift.covariance)
        return cls(shift.xi, W, float(shift.xi @ W @ shift.xi), adjoint(shift.T))


@dataclass(frozen=True, eq=False)
class Moved:
    """Motion of a sensor in its axes (rotation vector [rad], shift [m]), and probability that it moved."""

    probability: float
    motion: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Attribution:
    """Sensors that moved, with explanation and probabilities.

    Args:
        explanation: sentence for records and pages.
        moved: sensors that moved, by name, one or two; empty if the days cannot decide.
        probability: probability of each sensor, given that exactly one of them moved.
    """

    explanation: str
    moved: Mapping[str, Moved] = field(default_factory=dict)
    probability: Mapping[str, float] = field(default_factory=dict)

    @property
    def sensor(self) -> str | None:
        """The sensor that moved, the first if two did; None if the days cannot decide."""
        return next(iter(self.moved), None)

    def on(self, edge: Edge) -> str | None:
        """The moved sensor at an end of this edge; if there is none, the first moved sensor."""
        ends = [sensor.name for sensor in edge.sensors]
        return next((name for name in self.moved if name in ends), self.sensor)


def attribute(shifts: Mapping[Edge, PairShift], known_by: float = np.inf) -> Attribution:
    """Decide which sensors of a rig moved.

    Args:
        known_by: degrees of freedom of the estimated scale of the covariances; inf = the scale is known.
    """
    if len(shifts) < 2:
        names = [sensor.name for edge in shifts for sensor in edge.sensors]
        return Attribution(
            f"{' or '.join(names) or 'any sensor'}: only one pair has data, so its sensors cannot be distinguished"
        )
    total = sum(float(s.xi @ np.linalg.solve(s.covariance, s.xi)) for s in shifts.values())
    sensors = sorted(
        {s for edge in shifts for s in edge.sensors}, key=lambda s: (KINDS.index(s.kind), s.name)
    )
    names = [sensor.name for sensor in sensors]
    weighed = {edge: _Weighed.of(shift) for edge, shift in shifts.items()}
    fits = {name: _fit([name], weighed) for name in names}
    probability = _shares({name: fit[0] for name, fit in fits.items()})
    best = max(names, key=probability.__getitem__)
    cost, motion, covariance = fits[best]
    explains = _explains(cost, total, 6 * len(shifts) - 6, known_by)
    if probability[best] >= _CLEAR_PROBABILITY and explains:
        moved = {best: Moved(probability[best], motion, covariance)}
        return Attribution(f"the {best} moved", moved, probability)
    if not explains and (two := _two(names, weighed, total, known_by)):
        return Attribution(f"the {' and the '.join(two)} moved separately", two, probability)
    if probability[best] < _CLEAR_PROBABILITY:
        rivals = [name for name in names if probability[name] > 1 - _CLEAR_PROBABILITY]
        return Attribution(f"{' and '.join(rivals)} cannot be distinguished", {}, probability)
    text = f"no single sensor explains it ({best} comes nearest): several moved, or sigmas are too small"
    return Attribution(text, {}, probability)


def _two(
    names: Sequence[str], shifts: Mapping[Edge, _Weighed], total: float, known_by: float
) -> dict[str, Moved]:
    """Two sensors that explain the changes together; empty if no pair does, or not clearly."""
    freedom = 6 * len(shifts) - 12
    if len(names) < _FEWEST_FOR_TWO or freedom <= 0:
        return {}
    fits = {two: _fit(two, shifts) for two in combinations(names, 2)}
    share = _shares({two: fit[0] for two, fit in fits.items()})
    best = max(share, key=share.__getitem__)
    cost, motion, covariance = fits[best]
    if share[best] < _CLEAR_PROBABILITY or not _explains(cost, total, freedom, known_by):
        return {}
    parts = (slice(0, 6), slice(6, 12))
    return {
        name: Moved(share[best], motion[at], covariance[at, at]) for name, at in zip(best, parts, strict=True)
    }


def _shares(cost: Mapping[_Who, float]) -> dict[_Who, float]:
    """Probabilities of explanations from chi-squared, with equal prior probabilities."""
    least = min(cost.values())
    share = {who: float(np.exp(-0.5 * (c - least))) for who, c in cost.items()}
    return {who: value / sum(share.values()) for who, value in share.items()}


def _explains(cost: float, total: float, freedom: int, known_by: float) -> bool:
    """True if the residual of an explanation is noise or negligible.

    The scale of the residual was estimated from a few days, hence F instead of chi-squared (Hotelling 1931).
    """
    chance = fdtrc(freedom, min(known_by, _KNOWN), cost / freedom)
    return bool(chance >= _MISFIT_PROBABILITY or cost <= (1 - _WHOLE_STORY) * total)


def _fit(
    moving: Sequence[str], shifts: Mapping[Edge, _Weighed]
) -> tuple[float, Float[np.ndarray, " P"], Float[np.ndarray, "P P"]]:
    """Chi-squared, best motions and their covariance for moving sensors, six numbers each."""
    size = 6 * len(moving)
    information, moment, total = np.zeros((size, size)), np.zeros(size), 0.0
    for edge, shift in shifts.items():
        total += shift.square
        if edge.parent.name in moving or edge.child.name in moving:
            H = _design(moving, edge, shift)
            information += H.T @ shift.W @ H
            moment += H.T @ shift.W @ shift.xi
    # Two sensors whose only edge joins them cannot be distinguished: minimum-norm motion of both.
    covariance = (
        np.linalg.inv(information) if len(moving) == 1 else np.linalg.pinv(information, hermitian=True)
    )
    motion = covariance @ moment
    return total - float(moment @ motion), motion, covariance


def _design(moving: Sequence[str], edge: Edge, shift: _Weighed) -> Float[np.ndarray, "6 P"]:
    """d(xi of the edge)/d(motions of sensors in their own axes)."""
    H = np.zeros((6, 6 * len(moving)))
    for k, name in enumerate(moving):
        if name == edge.child.name:
            H[:, 6 * k : 6 * k + 6] = shift.adjoint
        elif name == edge.parent.name:
            H[:, 6 * k : 6 * k + 6] = -np.eye(6)
    return H
