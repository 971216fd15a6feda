"""Result of one edge of any kind beside its prior: input of the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.numerics.search_range import SearchRange
from pipeline.rig.changes import change_between, change_covariance
from pipeline.rig.se3 import adjoint, inverse
from schemas.calibrations import DOF_NAMES

__all__ = ["EdgeResult"]

_ON_BASE = ("roll", "pitch", "yaw", "x", "y", "z")


@dataclass(frozen=True, eq=False)
class EdgeResult:
    """T_parent_child of an edge, the prior that stays current without it, and what the day determined.

    The move from the prior is a change of T_parent_child, of an edge to the vehicle frame that of its inverse
    T_base_sensor: in T_sensor_base, a turn in the bracket would be a shift by the lever arm.

    Args:
        kind: kind of the edge, e.g. camera_lidar.
        covariance: of the left perturbation exp(xi) T [rad, m].
        observable: degrees of freedom that the day determined.
        prior: T_parent_child before the day.
        prior_sigma: of each number of a move, before the day [rad, m].
        search: what was searched about the prior.
        targets: in view of both sensors, in the child's frame [m].
    """

    kind: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    observable: Bool[np.ndarray, " 6"]
    prior: Float[np.ndarray, "4 4"]
    prior_sigma: Float[np.ndarray, " 6"]
    frames_used: int
    search: SearchRange
    targets: Float[np.ndarray, "N 3"]

    @property
    def move(self) -> Float[np.ndarray, " 6"]:
        """The move from the prior [rad, m]."""
        if self._is_on_base:
            return change_between(inverse(self.prior), inverse(self.T))
        return change_between(self.prior, self.T)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the six numbers of a move."""
        return _ON_BASE if self._is_on_base else DOF_NAMES

    @property
    def move_sigmas(self) -> Float[np.ndarray, " 6"]:
        """Size of the move in sigmas of the result; 0 for degrees of freedom that the day did not determine."""
        T, covariance = self.T, self.covariance
        if self._is_on_base:
            A = adjoint(inverse(T))
            T, covariance = inverse(T), A @ covariance @ A.T
        sigma = np.sqrt(np.diag(change_covariance(T, covariance)))
        return np.asarray(np.where(self.observable, np.abs(self.move) / sigma, 0.0))

    @property
    def _is_on_base(self) -> bool:
        return self.kind.endswith("_base")
