"""Result of one edge of any kind beside its prior: input of the verdict.

The move from the prior is the sensor's turn and the shift of its origin in axes of what it is mounted on. So a
sensor on the vehicle frame is given as T_base_sensor: as T_sensor_base, a turn in its bracket would be a
shift by its lever arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.numerics.search_range import SearchRange
from pipeline.geometry.changes import change_between, change_covariance
from schemas.calibrations import DOF_NAMES

__all__ = ["EdgeResult"]


@dataclass(frozen=True, eq=False)
class EdgeResult:
    """Pose of an edge, the prior that stays current without it, and what the day determined.

    Args:
        kind: kind of the edge, e.g. camera_lidar.
        T: T_parent_child, or its inverse for an edge to the vehicle frame.
        covariance: of the left perturbation exp(xi) T [rad, m].
        observable: degrees of freedom of T_parent_child that the day determined.
        prior: T before the day.
        prior_covariance: of a change (rotation vector, origin) of the prior [rad, m].
        search: what was searched about the prior.
        names: of the six numbers of a change.
    """

    kind: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    observable: Bool[np.ndarray, " 6"]
    prior: Float[np.ndarray, "4 4"]
    prior_covariance: Float[np.ndarray, "6 6"]
    frames_used: int
    search: SearchRange
    names: tuple[str, ...] = DOF_NAMES

    @property
    def move(self) -> Float[np.ndarray, " 6"]:
        """Change from the prior [rad, m]."""
        return change_between(self.prior, self.T)

    @property
    def move_prior_sigmas(self) -> Float[np.ndarray, " 6"]:
        """Size of the change from the prior, in sigmas of the prior."""
        return np.asarray(np.abs(self.move) / np.sqrt(np.diag(self.prior_covariance)))

    @property
    def move_sigmas(self) -> Float[np.ndarray, " 6"]:
        """Size of the change from the prior, in sigmas of the result; 0 if not determined."""
        sigma = np.sqrt(np.diag(change_covariance(self.T, self.covariance)))
        return np.asarray(np.where(self.observable, np.abs(self.move) / sigma, 0.0))
