"""What a calibration method is given and what it returns; shared by `calibrate` and `learn`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.extrinsics.checks import FailedCheck
from pipeline.geometry.changes import change_between
from pipeline.geometry.se3 import adjoint
from pipeline.rigs import CameraPrior

__all__ = ["DayParts", "PairEstimate", "Prior", "Solution"]


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the day: two transforms, the third composed of them, each with isotropic sigmas.

    A transform that the rig or the day lacks is NaN; a rig without a lidar has the third one alone.
    """

    T_camera_lidar: np.ndarray
    T_lidar_radar: np.ndarray
    rotation_sigma_rad: float
    translation_sigma_m: float
    # What an earlier day found, where one was accepted: a place to look at, no information.
    T_camera_lidar_before: np.ndarray | None = None
    camera: CameraPrior = field(default_factory=CameraPrior)
    # Azimuth of the car's way in lidar axes and its sigma [rad], where more than the day's radar shows it.
    heading: tuple[float, float] | None = None
    T_camera_radar_alone: np.ndarray | None = None  # of a rig, or a day, without a lidar

    @property
    def T_camera_radar(self) -> Float[np.ndarray, "4 4"]:
        """T_camera_lidar @ T_lidar_radar; the one given alone where these are unknown."""
        composed = self.T_camera_lidar @ self.T_lidar_radar
        alone = self.T_camera_radar_alone
        return composed if alone is None or np.isfinite(composed).all() else alone

    def knows(self, pair: str) -> bool:
        """Whether there is a prior of this pair."""
        return bool(np.isfinite(self.of(pair)).all())

    def of(self, pair: str) -> Float[np.ndarray, "4 4"]:
        """Prior transform of camera_lidar, camera_radar or lidar_radar; NaN where it is unknown."""
        return {
            "camera_lidar": self.T_camera_lidar,
            "camera_radar": self.T_camera_radar,
            "lidar_radar": self.T_lidar_radar,
        }[pair]

    def covariance(self, pair: str) -> Float[np.ndarray, "6 6"]:
        """Prior covariance (rotation vector, translation; left perturbation); camera_radar composes the other two."""
        base = np.diag([self.rotation_sigma_rad**2] * 3 + [self.translation_sigma_m**2] * 3)
        if pair != "camera_radar" or not (self.knows("camera_lidar") and self.knows("lidar_radar")):
            return base
        # Each prior is isotropic about its own sensor: the second one is only rotated into camera axes, no lever arm.
        A = adjoint(self.T_camera_lidar).copy()
        A[3:, :3] = 0
        return base + A @ base @ A.T


@dataclass(frozen=True, eq=False)
class DayParts:
    """A pair turned to fit the first and the last part of a day, cut where they differ most. Its position stays."""

    T: tuple[np.ndarray, np.ndarray]  # 4 4 of each part
    spread: tuple[np.ndarray, np.ndarray]  # 3 3 of each part's rotation vector, less what both err by alike
    cut_ns: tuple[int, int]  # stamps of the last frame before the cut and of the first one after it
    tested: tuple[int, ...]  # rotations (0, 1, 2) that the parts know by themselves

    @property
    def step(self) -> Float[np.ndarray, " 3"]:
        """Turn from the first part to the last, in the parent's axes [rad]."""
        return change_between(*self.T)[:3]

    def sigmas(self, floor_rad: float) -> Float[np.ndarray, " 3"]:
        """The step's rotations in units of their sigmas; 0 where the parts are not compared.

        Args:
            floor_rad: by which parts of one day differ though nothing moved, as their scenes differ.
        """
        sigma = np.sqrt(np.diag(self.spread[0] + self.spread[1]) + floor_rad**2)
        return np.where(np.isin(np.arange(3), self.tested), self.step / sigma, 0.0)


@dataclass(frozen=True, eq=False)
class PairEstimate:
    """One pair's result: T, its covariance, and which degrees of freedom the day determined.

    Degrees of freedom: rotation vector about the parent's axes [rad], then position of the child's origin [m].
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
    # 6 6, what all days of a vehicle err by alike; part of covariance.
    common_covariance: np.ndarray | None = None
    failed_checks: list[FailedCheck] = field(default_factory=list)  # of the solver's, on this pair alone
    parts: DayParts | None = None  # of the day; None where it is too short, or the method does not cut it
    disproved: str = ""  # why it cannot be right, where a check of the solver's shows that
    # Covariances 6 6 (left perturbation) of what all frames err by alike, parts of `covariance`: by "camera", "lidar"
    # or "radar" where every pair of that sensor errs by it, by "edge" where this pair alone does ...
    bias: dict[str, np.ndarray] = field(default_factory=dict)
    bias_in_weights: np.ndarray | None = (
        None  # ... and this pair's that the weight of its data has in it already
    )
    time_offset_prior_s: float | None = None  # what was expected of the time offset before the day

    @classmethod
    def at_prior(cls, pair: str, prior: Prior) -> PairEstimate:
        """The prior, where a pair is not estimated."""
        covariance, none = prior.covariance(pair), np.zeros(6)
        return cls(pair, prior.of(pair), covariance, none, none > 0, 0, common_covariance=covariance)


@dataclass(frozen=True, eq=False)
class Solution:
    """The pairs of the day, and how far the loop of three independent estimates is open, where the method made three.

    The loop's angle counts the rotations that were estimated independently; its translation is None where none was, as
    in `joint`, whose camera-radar estimate without the lidar takes its position from the prior.
    """

    method: str
    pairs: dict[str, PairEstimate]
    loop_rotation_rad: float | None = None
    loop_translation_m: float | None = None
    # By pair, checks that failed while solving: restarts or halves disagree, camera contradicts radar.
    failed_checks: dict[str, list[FailedCheck]] = field(default_factory=dict)
    apart: bool = (
        False  # no pair rests on another's data: the adjustment of the rig says what they show together
    )
