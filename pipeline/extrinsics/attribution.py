"""Which sensor moved: the one whose motion explains the shifts of all edges.

A sensor that moves by xi in its own axes shifts the edges that it is an end of, consistently, and leaves all others
alone:

    its edges as parent:  T_sensor_other' = exp(-xi) T_sensor_other
    its edges as child:   T_other_sensor' = T_other_sensor exp(xi)

With `T exp(xi) = exp(Ad_T xi) T` each is linear in xi, so each sensor's best motion is one generalised least squares
fit. A leaf of one edge is told from the sensor that it hangs on by that one's other edges, which stay. The vehicle
frame is a node like the others: that `base` moved means that all sensors moved against the road.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from scipy.stats import f as f_distribution

from pipeline.geometry.se3 import adjoint
from pipeline.rig.graph import KINDS, Edge

__all__ = ["Attribution", "Moved", "PairShift", "attribute"]

_Who = TypeVar("_Who", str, tuple[str, str])
_CLEAR_PROBABILITY = 0.95
# A best motion that explains the shifts worse than this is not the whole story ...
_MISFIT_PROBABILITY = 1e-3
_KNOWN = 1e9  # degrees of freedom: as good as infinitely many, for which SciPy's F has no value
_WHOLE_STORY = 0.99  # ... unless it explains this share of them (of chi-squared): sigmas are estimates
# Of three sensors, any two that move against the third explain all: two are looked for among more.
_FEWEST_FOR_TWO = 4


@dataclass(frozen=True, eq=False)
class PairShift:
    """Twist (left perturbation, parent axes [rad, m]) by which an edge changed, its 6x6 covariance, at `T`."""

    T: np.ndarray
    xi: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class _Weighed:
    """A shift with what every fit needs of it: its weight, what it weighs, and the adjoint of T."""

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
    """How a sensor moved: motion (rotation vector [rad], shift [m]) in its own axes, and how surely it was this one."""

    probability: float
    motion: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Attribution:
    """What moved, and why that is said.

    Args:
        explanation: in words.
        moved: by name the sensors that moved, one or two; none where the days cannot tell.
        probability: of each sensor against the others, given that exactly one of them moved.
    """

    explanation: str
    moved: Mapping[str, Moved] = field(default_factory=dict)
    probability: Mapping[str, float] = field(default_factory=dict)

    @property
    def sensor(self) -> str | None:
        """The sensor that moved, of two the first; None where the days cannot tell."""
        return next(iter(self.moved), None)

    def on(self, edge: Edge) -> str | None:
        """The sensor that an edge shows: the one of two that is an end of it, else the first."""
        ends = [sensor.name for sensor in edge.sensors]
        return next((name for name in self.moved if name in ends), self.sensor)


def attribute(shifts: Mapping[Edge, PairShift], known_by: float = np.inf) -> Attribution:
    """Decide between the sensors of a rig.

    Args:
        shifts: by edge, of edges whose errors are their own; at least two, else nothing can be told apart.
        known_by: degrees of freedom that the scale of the covariances is known to; inf = it is known.
    """
    if len(shifts) < 2:
        names = [sensor.name for edge in shifts for sensor in edge.sensors]
        return Attribution(f"{' or '.join(names) or 'any sensor'}: one pair alone has data, which both share")
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
        return Attribution(f"the {' and the '.join(two)} moved, each for itself", two, probability)
    if probability[best] < _CLEAR_PROBABILITY:
        rivals = [name for name in names if probability[name] > 1 - _CLEAR_PROBABILITY]
        return Attribution(f"cannot tell {' from '.join(rivals)}", {}, probability)
    text = f"no single sensor explains it ({best} comes nearest): several moved, or sigmas are too small"
    return Attribution(text, {}, probability)


def _two(
    names: Sequence[str], shifts: Mapping[Edge, _Weighed], total: float, known_by: float
) -> dict[str, Moved]:
    """The two sensors that explain what none does alone; empty where no two do, or not clearly these."""
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
    """Probabilities of explanations by their chi-squared, none likelier than another before."""
    least = min(cost.values())
    share = {who: float(np.exp(-0.5 * (c - least))) for who, c in cost.items()}
    return {who: value / sum(share.values()) for who, value in share.items()}


def _explains(cost: float, total: float, freedom: int, known_by: float) -> bool:
    """Whether what an explanation leaves is noise, or next to nothing.

    What is left, over a scale that the vehicle's own few days gave: F, not chi-squared (Hotelling 1931).
    """
    chance = f_distribution.sf(cost / freedom, freedom, min(known_by, _KNOWN))
    return bool(chance >= _MISFIT_PROBABILITY or cost <= (1 - _WHOLE_STORY) * total)


def _fit(
    moving: Sequence[str], shifts: Mapping[Edge, _Weighed]
) -> tuple[float, Float[np.ndarray, " P"], Float[np.ndarray, "P P"]]:
    """Chi-squared, motions and covariance of the best motions of some sensors, six numbers each."""
    size = 6 * len(moving)
    information, moment, total = np.zeros((size, size)), np.zeros(size), 0.0
    for edge, shift in shifts.items():
        total += shift.square
        if edge.parent.name in moving or edge.child.name in moving:
            H = _design(moving, edge, shift)
            information += H.T @ shift.W @ H
            moment += H.T @ shift.W @ shift.xi
    # Two sensors that share their only edge cannot be told apart: the least motion of both.
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
