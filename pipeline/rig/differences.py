"""Differences between two calibrations, or between a run and its truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.graph import Edge, words_of
from pipeline.rig.targets import Picks
from schemas.calibrations import CalibrationRecord

__all__ = ["ComparedRun", "Comparison", "PairDifference"]


@dataclass(frozen=True, eq=False)
class PairDifference:
    """Change from A's estimate of a pair to B's.

    Args:
        change: rotation vector [rad], shift of the child's origin [m], along the axes of the parent.
        sigma: sigmas of the change; None if neither side has any.
        determined: per DoF, determined by the data of both sides, or given.
        targets_rad: change of azimuth and elevation of targets 15 to 40 m away, root mean square.
    """

    edge: Edge
    statuses: tuple[str, str]
    change: Float[np.ndarray, " 6"]
    sigma: Float[np.ndarray, " 6"] | None
    determined: Bool[np.ndarray, " 6"]
    targets_rad: Float[np.ndarray, " 2"]

    @property
    def pair(self) -> str:
        """Text for the edge."""
        return words_of(self.edge)

    @property
    def z(self) -> Float[np.ndarray, " 6"] | None:
        """The change in units of sigma; None without sigmas."""
        return None if self.sigma is None else self.change / self.sigma


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of one run (all pairs with one work key) against the truth."""

    method: str
    environment: str
    errors: dict[str, np.ndarray]  # pair or "loop" -> azimuth, elevation [rad], range [m]
    prior_errors: dict[str, np.ndarray]
    statuses: dict[str, str]
    normalised: np.ndarray  # error / sigma of every observable DoF of all pairs
    # Loop of independently estimated pairs: angle [rad] and shift [m]; the shift is None if not determined.
    independent_loop: tuple[float, float | None] | None = None
    truth_spread: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # like errors: standard deviation of the picks in one frame
    truth_sigma: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # like errors: 1 sigma of the mean picked positions


class ComparedRun(NamedTuple):
    """One run (records by pair), the truth or picks it was compared with, and the result."""

    run: dict[str, CalibrationRecord]
    truth: dict[str, np.ndarray] | None
    picks: Picks | None
    comparison: Comparison
