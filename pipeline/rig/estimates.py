"""Inputs and outputs of a calibration method, and checks of one; shared by `calibrate` and `learn`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipeline.core.rigs import CameraPrior
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import adjoint, change_between
from schemas.faults import FAULTS

__all__ = [
    "EDGE", "HARMLESS", "Change", "Check", "DayParts", "EdgeEvidence", "OtherScenes", "PairEstimate", "Prior",
    "Solution", "change_of", "common_of", "common_part", "faults_of", "prior_share",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of the day: two transforms, the third composed of them, each with isotropic sigmas.

    A transform that the rig or the day lacks is NaN; a rig without a lidar has only the third one.
    """

    T_camera_lidar: np.ndarray
    T_lidar_radar: np.ndarray
    rotation_sigma_rad: float
    translation_sigma_m: float
    # Estimate of an earlier accepted day: a start for the search, without weight.
    T_camera_lidar_before: np.ndarray | None = None
    camera: CameraPrior = field(default_factory=CameraPrior)
    # Azimuth of the direction of travel in lidar axes and its sigma [rad], if known better than from the
    # day's radar.
    heading: tuple[float, float] | None = None
    T_camera_radar_alone: np.ndarray | None = None  # for a rig or a day without a lidar
    T_base_radar: np.ndarray | None = None  # pose on the vehicle, whose x points ahead; None if unknown

    @property
    def T_ahead_radar(self) -> Float[np.ndarray, "4 4"]:
        """The radar's pose in axes whose x points ahead: a lidar's, else the vehicle's; NaN if both are unknown."""
        base = self.T_base_radar
        return self.T_lidar_radar if base is None or np.isfinite(self.T_lidar_radar).all() else base

    @property
    def T_camera_radar(self) -> Float[np.ndarray, "4 4"]:
        """T_camera_lidar @ T_lidar_radar; if these are unknown, the transform given directly."""
        composed = self.T_camera_lidar @ self.T_lidar_radar
        alone = self.T_camera_radar_alone
        return composed if alone is None or np.isfinite(composed).all() else alone

    @property
    def sigmas(self) -> tuple[float, float]:
        """Of rotation [rad] and translation [m], each axis."""
        return self.rotation_sigma_rad, self.translation_sigma_m

    def knows(self, pair: str) -> bool:
        """True if this pair has a prior."""
        return bool(np.isfinite(self.of(pair)).all())

    def of(self, pair: str) -> Float[np.ndarray, "4 4"]:
        """Prior transform of camera_lidar, camera_radar or lidar_radar; NaN if unknown."""
        return {
            "camera_lidar": self.T_camera_lidar,
            "camera_radar": self.T_camera_radar,
            "lidar_radar": self.T_lidar_radar,
        }[pair]

    def covariance(self, pair: str) -> Float[np.ndarray, "6 6"]:
        """Prior covariance (rotation vector, translation; left perturbation); composed for camera_radar."""
        base = np.diag([self.rotation_sigma_rad**2] * 3 + [self.translation_sigma_m**2] * 3)
        if pair != "camera_radar" or not (self.knows("camera_lidar") and self.knows("lidar_radar")):
            return base
        # Each prior is isotropic about its own sensor: rotate the second into camera axes, without lever arm.
        A = adjoint(self.T_camera_lidar).copy()
        A[3:, :3] = 0
        return base + A @ base @ A.T


@dataclass(frozen=True, eq=False)
class DayParts:
    """A pair's rotation fitted to the first and the last part of a day, cut at the largest difference."""

    T: tuple[np.ndarray, np.ndarray]  # 4 4 of each part
    spread: tuple[np.ndarray, np.ndarray]  # 3 3 of each part's rotation vector, without common errors
    cut_ns: tuple[int, int]  # stamps of the last frame before the cut and of the first one after it
    tested: tuple[int, ...]  # rotations (0, 1, 2) that both parts determine without the prior

    @property
    def step(self) -> Float[np.ndarray, " 3"]:
        """Rotation from the first part to the last, in the parent's axes [rad]."""
        return change_between(*self.T)[:3]

    def sigmas(self, floor_rad: float) -> Float[np.ndarray, " 3"]:
        """Rotations of the step in units of their sigmas; 0 for rotations that are not compared.

        Args:
            floor_rad: difference between parts of one day without motion, due to different scenes (1 sigma).
        """
        sigma = np.sqrt(np.diag(self.spread[0] + self.spread[1]) + floor_rad**2)
        of, found = list(self.tested), np.zeros(3)
        found[of] = self.step[of] / sigma[of]
        return found


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """Result for one pair: T, covariance, and the degrees of freedom that the day determined.

    Degrees of freedom: rotation vector about the parent's axes [rad], then position of the child's origin
    [m].
    """

    pair: str
    T: np.ndarray  # 4 4
    covariance: np.ndarray  # 6 6, of the left perturbation exp(xi) T [rad, m]
    observability: np.ndarray  # 6, share 0..1 of the prior's variance that the day removed
    observable: np.ndarray  # 6, bool; the others keep the prior
    frames_used: int
    frames_rejected: dict[str, int] = field(default_factory=dict)
    time_offset_s: float | None = None  # stamp_parent = stamp_child + dt
    time_offset_sigma_s: float | None = None
    diagnostics: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    # 6 6, from errors common to all days of a vehicle; part of covariance.
    common_covariance: np.ndarray | None = None
    failed_checks: list[Check] = field(default_factory=list)  # checks of the solver, on this pair alone
    parts: DayParts | None = None  # None if the day is too short, or if the method does not cut it
    disproved: str = ""  # why the estimate is certainly wrong, if a check of the solver shows that
    # Covariances 6 6 (left perturbation) of errors common to all frames, parts of `covariance`: by "camera",
    # "lidar" or "radar" for errors common to all pairs of that sensor, by "edge" for errors of this pair
    # alone ...
    bias: dict[str, np.ndarray] = field(default_factory=dict)
    bias_in_weights: np.ndarray | None = (
        None  # ... and of errors of this pair that are already included in the weights of its data
    )
    time_offset_prior_s: float | None = None  # expected time offset before the day

    @classmethod
    def at_prior(cls, pair: str, prior: Prior) -> PairEstimate:
        """The prior, for a pair without an estimate."""
        covariance, none = prior.covariance(pair), np.zeros(6)
        return cls(pair, prior.of(pair), covariance, none, none > 0, 0, common_covariance=covariance)

    def doubted(self, doubt: Float[np.ndarray, "6 6"]) -> PairEstimate:
        """The estimate with an error besides that all its frames, and all its days, may have."""
        if not doubt.any():
            return self
        common = None if self.common_covariance is None else self.common_covariance + doubt
        bias = self.bias | {"edge": self.bias.get("edge", np.zeros((6, 6))) + doubt}
        return replace(self, covariance=self.covariance + doubt, common_covariance=common, bias=bias)


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimates of the day's pairs, and the loop of three independent estimates, if the method made them.

    The loop's angle covers the independently estimated rotations. Its translation is None if none was
    estimated independently, as in `joint`, where camera-radar without the lidar takes its position from the
    prior.
    """

    method: str
    pairs: dict[str, PairEstimate]
    loop_rotation_rad: float | None = None
    loop_translation_m: float | None = None
    # Failed checks while solving, by pair: starts or halves disagree, camera contradicts radar.
    failed_checks: dict[str, list[Check]] = field(default_factory=dict)


# --------------------------------------------------------------------------------------------------
# Part of a day's covariance from errors common to all days of a vehicle.
#
# The error of a day has two parts. One is independent from day to day: scenes and noise. The other is the same
# every day: bias floors (masks, intrinsics, reflections of cars in radar) and the error of the prior, as far as
# estimates depend on it. Averaging over days does not reduce the common part, and changes between days do not
# contain it.


def prior_share(
    covariance: Float[np.ndarray, "P P"], prior_information: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance of a MAP estimate C due to its prior P, whose error adds `C P^-1 (prior's error)` to it."""
    share = covariance @ prior_information @ covariance
    return 0.5 * (share + share.T)


def common_part(
    common: Float[np.ndarray, "P P"], covariance: Float[np.ndarray, "P P"]
) -> Float[np.ndarray, "P P"]:
    """`common`, limited to `covariance` in every direction, so that the difference is a covariance too."""
    scale = 1 / np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky(covariance * np.outer(scale, scale))
    W = np.linalg.solve(L, np.linalg.solve(L, common * np.outer(scale, scale)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = (L @ vectors) / scale[:, None]
    return (root * np.clip(values, 0.0, 1.0)) @ root.T


def common_of(
    covariance: Float[np.ndarray, "6 6"],
    prior_covariance: Float[np.ndarray, "6 6"],
    bias: Float[np.ndarray, "6 6"],
) -> Float[np.ndarray, "6 6"]:
    """Common covariance of an estimate with one bias floor (a covariance) and one prior."""
    return common_part(bias + prior_share(covariance, np.linalg.inv(prior_covariance)), covariance)


# --------------------------------------------------------------------------------------------------
# Result of one edge without the prior: the input of the rig's adjustment.

EDGE = "edge"  # owner of a bias from the matching of the two sensors


@dataclass(frozen=True, eq=False)
class OtherScenes:
    """What scenes show of a fit in which they took no part: the day in two halves, each beside the other's fit.

    Args:
        shift: 6, left perturbation by which they would move T [rad, m].
        covariance: 6 6, of that shift if both halves are right.
        cost: before, after, block (F each): mismatch of a moment at the prior and at the other half's fit, lower is
            better, and the block of its scene; None for an edge whose fit cannot end in another place.
    """

    shift: np.ndarray
    covariance: np.ndarray
    cost: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class EdgeEvidence:
    """A quadratic cost of one edge around T: 1/2 x' information x - gradient' x, with x = (xi, dt).

    xi is the left perturbation T_parent_child <- exp(xi) T [rad, m] in the parent's axes, dt [s] the change
    of the child's clock: stamp_parent = stamp_child + dt_s + dt. Undetermined directions have zero
    information.

    Args:
        dt_s: clock offset at that point.
        information: 7 7, from the data alone, robust (it includes the scatter between scenes).
        gradient: 7, descent: without a prior the step is information^-1 gradient.
        bias: covariances 6 6 of errors common to all frames, by owner: a sensor's name (error of its
            intrinsics or elevation, as an apparent rotation in the sensor's axes), or EDGE (in the parent's
            axes).
        checks: failed checks of this edge. Such an edge is left out of the adjustment.
        others: scenes that took no part in a fit; None for pairs, whose held-out frames are judged apart.
        parts: first and last part of the day; None if it is too short.
        diagnostics: numbers for the record, names with units.
    """

    edge: Edge
    T: np.ndarray
    dt_s: float
    information: np.ndarray
    gradient: np.ndarray
    bias: Mapping[str, np.ndarray] = field(default_factory=dict)
    frames_used: int = 0
    frames_rejected: Mapping[str, int] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    others: OtherScenes | None = None
    parts: DayParts | None = None

    def __post_init__(self) -> None:
        assert self.T.shape == (4, 4)
        assert self.information.shape == (7, 7)
        assert self.gradient.shape == (7,)
        owners = {EDGE, *(s.name for s in self.edge.sensors)}
        assert set(self.bias) <= owners, f"{self.edge.name} has biases of {set(self.bias) - owners}"


# Rotation vector and shift of the child's origin, both along the parent's axes [rad, m], as `se3.changed`.
Change = tuple[float, float, float, float, float, float]
HARMLESS: Change = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Check:
    """One condition: the sentence if it fails, its fault in `schemas.faults` if it has one, and what it is worth.

    Args:
        fault: key of FAULTS; empty if the check cannot name the cause.
        disproves: the pose is certainly wrong and must not be used, not only unproved.
        error: by how much the pose would be wrong if the check is right: it holds a record only where that
            matters against its limits. None = nobody knows, so that it always holds.
        covariance: of the pose that would be right then, as left perturbation [rad, m]; None where the check
            fails from three sigmas on in all that it can show, so that it knows the error to a third.
        margin: 1 = far inside of its limit, 0 = at it; below 0 it failed.
        of_sigma: if it fails, the pose may still be within its sigma, but the sigma is too large.
    """

    sentence: str
    fault: str = ""
    disproves: bool = False
    error: Change | None = None
    covariance: Float[np.ndarray, "6 6"] | None = field(default=None, compare=False)
    margin: float = -1.0
    of_sigma: bool = False

    def __post_init__(self) -> None:
        assert not self.fault or self.fault in FAULTS, self.fault


def change_of(change: Iterable[float]) -> Change:
    """Six numbers as a change."""
    rx, ry, rz, x, y, z = (float(v) for v in change)
    return rx, ry, rz, x, y, z


def faults_of(checks: Iterable[Check]) -> list[str]:
    """Faults of the checks, each once, in order."""
    return list(dict.fromkeys(check.fault for check in checks if check.fault))
