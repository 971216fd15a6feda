"""Poses of all sensors of a rig relative to one reference, with their joint covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.rig.graph import Sensor
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["Extrinsics"]


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
