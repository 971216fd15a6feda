"""Prior of a rig: transforms between sensors and their sigmas.

Transforms form a star from one sensor in the middle (usually the first lidar) to the others. Sensors not
connected to it form another star. Transforms of the star's edges keep their given numbers exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import SolveError
from pipeline.rig.graph import BASE, KINDS, Kind, Sensor
from pipeline.rig.se3 import (
    adjoint,
    from_quaternion,
    from_rotation_translation,
    inverse,
    log_se3,
    perturb_exactly,
    to_quaternion,
)

__all__ = [
    "Extrinsics", "RigPrior", "Star", "agreed", "between", "from_rows", "middle_of", "moved", "star_of",
    "to_rows", "transform_of_row",
]  # fmt: skip

Star = Mapping[tuple[str, str], np.ndarray]  # T_parent_child 4 4 by (parent, child)

_SAME = 1e-6  # rad and m: logs repeat transforms without noise
_MIDDLES: tuple[Kind, ...] = ("lidar", "radar", "camera")
# Order in which `moved` draws perturbations for a rig with one sensor of each kind; unchanged since release
# 0.1.
_DRAWN: tuple[tuple[Kind, Kind], ...] = (("camera", "lidar"), ("lidar", "radar"), ("camera", "radar"))


@dataclass(frozen=True, eq=False)
class RigPrior:
    """Transforms between sensors, and the sigmas of each sensor.

    If the rig has a vehicle frame, all sensors are mounted on it, the reference included: the reference's
    mounting error is part of all poses in it. Without a vehicle frame, sensors are mounted on the reference.

    Args:
        T: transforms of the stars, by (parent, child).
        sigmas: sigma of each sensor's mounting: rotation [rad] and translation [m], isotropic about the
            sensor.
        is_base_loose: no sensor is mounted on the vehicle frame, which the day places (`edges/sweep_travel`).
    """

    nodes: tuple[Sensor, ...]
    reference: Sensor
    T: Star
    sigmas: Mapping[str, tuple[float, float]]
    is_base_loose: bool = False

    def between(self, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
        """T_a_b; None if the star does not connect them."""
        return between(self.T, a, b)

    def sigmas_between(self, a: str, b: str) -> tuple[float, float]:
        """Sigmas of T_a_b: rotation [rad], translation [m], without lever arms; not summed if T_a_b is given."""
        own = [self.sigmas[n] for n in (a, b) if n not in self._exact]
        rotation, translation = zip(*own, strict=True)
        if self._exact == (BASE.name,) or _direct(self.T, a, b) is None:
            return float(np.hypot.reduce(rotation)), float(np.hypot.reduce(translation))
        return max(rotation), max(translation)

    @property
    def _exact(self) -> tuple[str]:
        """The node on which the others are mounted."""
        return (BASE.name,) if BASE in self.nodes and not self.is_base_loose else (self.reference.name,)

    @property
    def untied(self) -> tuple[Sensor, ...]:
        """Nodes without a known pose relative to the reference."""
        return tuple(n for n in self.nodes if self.between(self.reference.name, n.name) is None)

    def extrinsics(self) -> Extrinsics:
        """Poses of all nodes connected to the reference, with covariance.

        Mounting errors rotate a sensor about itself. The prior is the same on every day, so the whole
        covariance is common.
        """
        T = {n.name: self.between(self.reference.name, n.name) for n in self.nodes}
        poses = {name: pose for name, pose in T.items() if pose is not None}
        order = tuple(name for name in poses if name != self.reference.name)
        covariance = np.zeros((6 * len(order), 6 * len(order)))
        for k, name in enumerate(order):
            if name not in self._exact:
                covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = self._mounted(name, poses[name])
        if self.reference.name not in self._exact:
            shared = self._mounted(self.reference.name, np.eye(4))
            covariance += np.tile(shared, (len(order), len(order)))
        return Extrinsics(self.reference, poses, order, covariance, covariance.copy())

    def _mounted(self, name: str, T_reference_sensor: np.ndarray) -> np.ndarray:
        """Covariance 6 6 of a sensor's mounting, as left perturbation in the reference."""
        rotation, translation = self.sigmas[name]
        A = adjoint(from_rotation_translation(np.eye(3), T_reference_sensor[:3, 3]))
        return A @ np.diag([rotation**2] * 3 + [translation**2] * 3) @ A.T


def middle_of(nodes: Iterable[Sensor]) -> Sensor:
    """Default middle of a star: the first lidar, else the first radar, else the first camera."""
    return min((n for n in nodes if n.kind in _MIDDLES), key=lambda n: _MIDDLES.index(n.kind))


def star_of(
    nodes: Sequence[Sensor], transform: Callable[[str, str], Float[np.ndarray, "4 4"] | None]
) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Stars of known transforms: one about the middle, another for nodes that it does not reach, and so on.

    `transform` returns T_a_b for two names, None if no chain of transforms connects them.
    """
    found, left = dict[tuple[str, str], np.ndarray](), list(nodes)
    while any(n.kind in _MIDDLES for n in left):
        middle = middle_of(left)
        left.remove(middle)
        for node in tuple(left):
            parent, child = sorted((middle, node), key=lambda n: KINDS.index(n.kind))
            T = transform(parent.name, child.name)
            if T is not None:
                found[parent.name, child.name] = T
                left.remove(node)
    return found


def to_rows(stars: Iterable[Star]) -> list[dict[str, Any]]:
    """Stars as JSON rows: each distinct transform once, quaternion (w x y z) and translation [m]."""
    rows = [
        {"parent": a, "child": b, "q": to_quaternion(T).tolist(), "t_m": T[:3, 3].tolist()}
        for star in stars
        for (a, b), T in star.items()
    ]
    return [row for i, row in enumerate(rows) if row not in rows[:i]]


def from_rows(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """The star common to all logs of the day; raises SolveError if a transform changes over the day."""
    ordered = sorted(rows, key=lambda row: (*row["q"], *row["t_m"]))
    return agreed({(row["parent"], row["child"]): transform_of_row(row)} for row in ordered)


def transform_of_row(row: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """T_parent_child of a JSON row."""
    return from_quaternion(np.array(row["q"], np.float64), np.array(row["t_m"], np.float64))


def agreed(stars: Iterable[Star]) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """One star from several equal ones, with the numbers of the first; SolveError if a transform changes."""
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    for ends, T in (item for star in stars for item in star.items()):
        found.setdefault(ends, []).append(T)
    for (a, b), values in found.items():
        if max(np.abs(log_se3(inverse(values[0]) @ T)).max() for T in values) > _SAME:
            raise SolveError(f"the logged prior of {a}_{b} changes over the day ({len(values)} values)")
    return {ends: values[0] for ends, values in found.items()}


def moved(prior: RigPrior, angle_rad: float, shift_m: float, seed: int) -> RigPrior:
    """The prior with all sensors except the reference moved by exact amounts; sigmas at least as large.

    In a rig with one sensor of each kind the transforms are moved as in release 0.1: camera-lidar, then
    lidar-radar.
    """
    rng = np.random.default_rng(seed)
    kinds = [n.kind for n in prior.nodes]
    if len(set(kinds)) == len(kinds) and "base" not in kinds:
        T = _moved_as_pairs(prior, angle_rad, shift_m, rng)
    else:
        others = [n.name for n in prior.nodes if n not in (prior.reference, *prior.untied)]
        pose = prior.extrinsics().T
        T = {
            (prior.reference.name, n): perturb_exactly(pose[n], angle_rad, shift_m, rng) for n in others
        } | {
            ends: T for ends, T in prior.T.items() if not {*others, prior.reference.name} & set(ends)
        }  # fmt: skip
    sigmas = {n: (max(r, angle_rad), max(t, shift_m)) for n, (r, t) in prior.sigmas.items()}
    return replace(prior, T=T, sigmas=sigmas)


def _moved_as_pairs(
    prior: RigPrior, angle_rad: float, shift_m: float, rng: np.random.Generator
) -> dict[tuple[str, str], np.ndarray]:
    name = {n.kind: n.name for n in prior.nodes}
    T = dict(prior.T)
    for a, b in _DRAWN:
        ends = (name.get(a, ""), name.get(b, ""))
        # Draw for an absent pair too, so that the draws of the others stay the same.
        drawn = perturb_exactly(T.get(ends, np.eye(4)), angle_rad, shift_m, rng)
        T |= {ends: drawn} if ends in T else {}
    return T


def between(T: Star, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
    """T_a_b from a star; None if the star does not connect them."""
    direct = _direct(T, a, b)
    if direct is not None:
        return direct
    for middle in dict.fromkeys(name for ends in T for name in ends):
        first, second = _direct(T, a, middle), _direct(T, middle, b)
        if middle not in (a, b) and first is not None and second is not None:
            return first @ second
    return None


def _direct(T: Star, a: str, b: str) -> Float[np.ndarray, "4 4"] | None:
    if a == b:
        return np.eye(4)
    return T[a, b] if (a, b) in T else inverse(T[b, a]) if (b, a) in T else None


# --------------------------------------------------------------------------------------------------
# Poses of all sensors of a rig relative to one reference, with their joint covariance.


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """T_reference_sensor of each sensor; also used for a prior.

    Perturbations are on the left, in the reference's axes: T <- exp(xi) T, rotation vector [rad], translation
    [m]. The reference has the identity, and no rows in the covariance.

    Args:
        order: sensors in the order of the covariance's rows, six rows each, without the reference.
        covariance: of all perturbations jointly.
        common: part of the covariance from errors common to all days of a vehicle.
        dt_s: clock offsets by sensor name, if estimated: stamp_reference = stamp_sensor + dt.
    """

    reference: Sensor
    T: Mapping[str, np.ndarray]
    order: tuple[str, ...]
    covariance: np.ndarray  # 6S 6S
    common: np.ndarray  # 6S 6S
    dt_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert self.covariance.shape == self.common.shape == (6 * len(self.order),) * 2
        assert self.reference.name not in self.order
        assert set(self.T) == {self.reference.name, *self.order}

    def between(self, a: str, b: str) -> Float[np.ndarray, "4 4"]:
        """T_a_b."""
        return inverse(self.T[a]) @ self.T[b]

    def covariance_between(self, a: str, b: str, *, common: bool = False) -> Float[np.ndarray, "6 6"]:
        """Covariance of T_a_b's left perturbation, in a's axes; with `common`, only its common part."""
        J = self.jacobian_between(a, b)
        return J @ (self.common if common else self.covariance) @ J.T

    def jacobian_between(self, a: str, b: str) -> Float[np.ndarray, "6 P"]:
        """Derivative of T_a_b's left perturbation with respect to those of all sensors.

        exp(xi) T_a_b with xi = Ad(T_a_reference) (xi_b - xi_a).
        """
        J = np.zeros((6, 6 * len(self.order)))
        A = adjoint(inverse(self.T[a]))
        for name, sign in ((a, -1.0), (b, 1.0)):
            if name != self.reference.name:
                k = 6 * self.order.index(name)
                J[:, k : k + 6] += sign * A
        return J
