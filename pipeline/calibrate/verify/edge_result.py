"""Result of one edge of any kind beside its prior: input of the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.numerics.search_range import SearchRange
from pipeline.geometry.changes import change_between, change_covariance

__all__ = ["EdgeResult"]


@dataclass(frozen=True, eq=False)
class EdgeResult:
    """T_parent_child of an edge, the prior that stays current without it, and what the day determined.

    Args:
        kind: kind of the edge, e.g. camera_lidar.
        covariance: of the left perturbation exp(xi) T [rad, m].
        observable: degrees of freedom that the day determined.
        prior: T_parent_child before the day.
        prior_covariance: of a change (rotation vector, child's origin) of the prior [rad, m].
        search: what was searched about the prior.
    """

    kind: str
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    observable: Bool[np.ndarray, " 6"]
    prior: Float[np.ndarray, "4 4"]
    prior_covariance: Float[np.ndarray, "6 6"]
    frames_used: int
    search: SearchRange

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
