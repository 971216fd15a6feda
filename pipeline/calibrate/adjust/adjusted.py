"""Result of the adjustment of a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.equations import inverse_of_information
from pipeline.rig.changes import change_jacobian
from pipeline.rig.checks import FailedCheck
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge

__all__ = ["AdjustedEdge", "AdjustedRig", "AdjustedSensor", "AdjustmentLimits"]


@dataclass(frozen=True)
class AdjustmentLimits:
    """Assumptions of the adjustment: each sensor's clock sigma, and the limit of an edge's innovation.

    `innovation_sigmas` holds for a whole rig, however many edges it has.
    """

    clock_sigma_s: float
    innovation_sigmas: float = 3.0

    def __post_init__(self) -> None:
        assert self.clock_sigma_s > 0
        assert self.innovation_sigmas > 0


@dataclass(frozen=True, eq=False)
class AdjustedEdge:
    """An edge, compared with the adjusted rig.

    Args:
        innovation_sigmas: distance from the pose by all other edges in use; None = only the prior checks it.
        failed: reason for leaving it out; empty = it is used.
        doubts: edges of which one, unknown which, is wrong; all but one of them are used.
    """

    evidence: EdgeEvidence
    innovation_sigmas: float | None
    failed: tuple[FailedCheck, ...] = ()
    doubts: tuple[Edge, ...] = ()

    @property
    def used(self) -> bool:
        """Whether the rig uses it."""
        return not self.failed


@dataclass(frozen=True, eq=False)
class AdjustedSensor:
    """Uncertainty of a sensor's pose to the reference.

    Degrees of freedom: rotation vector about the reference's axes, then the sensor's origin in them.

    Args:
        determined: 6, bool; the other degrees of freedom depend on the prior.
        rests_on: edges that its pose depends on: without one of them, its covariance is larger.
        untied: reason why the day does not determine its pose to the reference; empty = it does.
        doubts: edges that it depends on, of which one, unknown which, is wrong.
    """

    observability: np.ndarray
    determined: np.ndarray
    rests_on: tuple[Edge, ...]
    untied: str
    doubts: tuple[Edge, ...]
    dt_sigma_s: float


@dataclass(frozen=True, eq=False)
class AdjustedRig:
    """Poses and clocks of all sensors, with the state of each edge and the uncertainty of each sensor.

    Args:
        poses: all poses, with their joint covariance.
        of_prior: part of that covariance that is the error of the prior.
    """

    poses: Extrinsics
    of_prior: np.ndarray
    before: Extrinsics
    sensors: Mapping[str, AdjustedSensor]
    edges: Mapping[Edge, AdjustedEdge]

    def observability(self, a: str, b: str) -> Float[np.ndarray, " 6"]:
        """Share of each variance of T_a_b (rotation vector in a's axes, b's origin) that the day removed.

        For a rotation it is 1 - posterior/prior, with the other sensors at their poses, because a rotated
        reference gives no information on another sensor's rotation. For a position it is the share of the
        variance that is not the prior's error. So a position that only the prior determines, given the
        rotation, does not count as observed. A rotation may be found to a hundredth of the prior and depend
        on a position.
        """
        J = change_jacobian(self.poses.between(a, b)) @ self.poses.jacobian_between(a, b)
        variance = np.diag(J @ self.poses.covariance @ J.T)
        share = 1 - np.diag(J @ self.of_prior @ J.T) / variance
        share[:3] = 1 - variance[:3] / self._turns_before(a, b)
        return np.clip(share, 0.0, 1.0)

    def _turns_before(self, a: str, b: str) -> Float[np.ndarray, " 3"]:
        """Prior variances of the rotation between two sensors, with the others in place [rad^2]."""
        own = [6 * k + i for k, name in enumerate(self.before.order) if name in (a, b) for i in range(6)]
        information = inverse_of_information(self.before.covariance)
        given_others = inverse_of_information(information[np.ix_(own, own)])
        J = self.before.jacobian_between(a, b)[:3, own]
        return np.diag(J @ given_others @ J.T)

    @property
    def left_out(self) -> tuple[Edge, ...]:
        """Edges with evidence that the rig does not use."""
        return tuple(e for e, found in self.edges.items() if not found.used)
