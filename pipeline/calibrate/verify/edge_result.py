"""Result of one edge of any kind beside its prior: input of the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.verify.target_accuracy import DIRECTIONS, Claim
from pipeline.core.sections import SearchRange
from pipeline.rig.estimates import Change, Check, PairEstimate
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.se3 import adjoint, change_between, change_covariance, change_jacobian, changed, inverse
from pipeline.rig.targets import errors_at_targets, target_sigmas
from schemas.calibrations import DOF_NAMES
from schemas.words import AXIS_NAMES

__all__ = ["RANGE", "EdgeResult", "at_targets", "exceeded_by", "tilt_in_doubt"]


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

    @classmethod
    def of(
        cls, estimate: PairEstimate, prior: np.ndarray, prior_sigma: np.ndarray, search: SearchRange,
        targets: np.ndarray,
    ) -> EdgeResult:  # fmt: skip
        """The result of an estimate."""
        own = estimate.pair, estimate.T, estimate.covariance, estimate.observable
        return cls(*own, prior, prior_sigma, estimate.frames_used, search, targets)

    @property
    def move(self) -> Float[np.ndarray, " 6"]:
        """The move from the prior [rad, m]."""
        if self._is_on_base:
            return change_between(inverse(self.prior), inverse(self.T))
        return change_between(self.prior, self.T)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the six numbers of a move."""
        return AXIS_NAMES["base" if self._is_on_base else self.kind.partition("_")[0]]

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


# --------------------------------------------------------------------------------------------------
# Consequence of a failed check: what it would mean at the targets, against the limits, if it is right.


RANGE = "range"
_SIGMAS = 3.0


def exceeded_by(result: EdgeResult, claims: Mapping[str, Claim], check: Check) -> list[str]:
    """Directions whose limit the pose would exceed if the check is right: azimuth, elevation, range.

    A shift along the line of sight moves no direction; it counts as if it were across it, against the limit
    of azimuth. All of them where nobody knows the check's error.
    """
    if check.error is None:
        return [*claims, RANGE]
    limits = {**claims, RANGE: claims[DIRECTIONS[0]].without_sigma}
    return [
        n
        for n, (off, known_to) in at_targets(result, check).items()
        if n in limits and limits[n].is_exceeded_by(off, known_to)  # what is not claimed has no limit
    ]


def at_targets(result: EdgeResult, check: Check) -> dict[str, tuple[float, float | None]]:
    """Error of each direction if the check is right, and its sigma, None where the check states none [rad]."""
    assert check.error is not None
    off = _errors(result, check.error)
    known_to = (None, None, None) if check.covariance is None else _sigmas(result, check.covariance)
    return dict(zip((*DIRECTIONS, RANGE), zip(off, known_to, strict=True), strict=True))


def tilt_in_doubt(result: EdgeResult, check: Check) -> Float[np.ndarray, "6 6"] | None:
    """What is to be added to the covariance, as left perturbation, where a check doubts a radar's tilt.

    Its roll, pitch or height may then be off by more than three sigmas. The record certifies no elevation, however
    little targets see of it, but its pose has that tilt: whoever combines poses must not take it for sure.
    None where the check doubts none.
    """
    tilts = [DOF_NAMES.index(name) for name in KIND_OF_EDGE[result.kind].tilts]
    if check.error is None or not tilts:
        return None
    off, variance = np.zeros(6), np.zeros(6)
    off[tilts] = np.array(check.error)[tilts]
    if check.covariance is not None:
        variance[tilts] = np.diag(change_covariance(result.T, check.covariance))[tilts]
    own = np.sqrt(np.diag(change_covariance(result.T, result.covariance)))
    if (np.abs(off) + np.sqrt(variance) <= _SIGMAS * own)[tilts].all():
        return None
    back = np.linalg.inv(change_jacobian(result.T))
    return np.asarray(back @ (np.outer(off, off) + np.diag(variance)) @ back.T)


def _errors(result: EdgeResult, error: Change) -> tuple[float, float, float]:
    change = np.array(error)
    # A turn moves ranges by its lever arm: no more than directions.
    shift = np.where(np.arange(6) < 3, 0.0, change)
    kind, T, targets = result.kind, result.T, result.targets
    azimuth, elevation, _ = errors_at_targets(kind, changed(T, change), T, targets)
    range_m = errors_at_targets(kind, changed(T, shift), T, targets)[2]
    return float(azimuth), float(elevation), float(range_m) * _per_metre(targets)


def _sigmas(result: EdgeResult, covariance: Float[np.ndarray, "6 6"]) -> tuple[float, float, float]:
    azimuth, elevation = target_sigmas(result.kind, result.T, covariance, result.targets)
    along = result.targets @ result.T[:3, :3].T
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    shift = change_covariance(result.T, covariance)[3:, 3:]
    range_m = float(np.sqrt(np.einsum("ni,ij,nj->n", along, shift, along).mean()))
    return float(azimuth), float(elevation), range_m * _per_metre(result.targets)


def _per_metre(targets: Float[np.ndarray, "N 3"]) -> float:
    return float(np.mean(1 / np.linalg.norm(targets, axis=1)))
