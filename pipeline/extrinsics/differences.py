"""What lies between two calibrations, or between a run and its truth: measured by one room, shown by another."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry.targets import Picks
from pipeline.rig.edges import words_of
from pipeline.rig.graph import Edge
from schemas.calibrations import CalibrationRecord

__all__ = ["ComparedRun", "Comparison", "PairDifference"]


@dataclass(frozen=True, eq=False)
class PairDifference:
    """What leads from A's estimate of a pair to B's.

    Args:
        edge: of two sensors.
        statuses: of A and B.
        change: rotation vector [rad], shift of the child's origin [m], along the axes of the parent.
        sigma: of it; None where neither side states any.
        determined: per DoF, both sides' data did, or are taken as given.
        targets_rad: how far azimuth and elevation of targets 15 to 40 m away move, root mean square.
    """

    edge: Edge
    statuses: tuple[str, str]
    change: Float[np.ndarray, " 6"]
    sigma: Float[np.ndarray, " 6"] | None
    determined: Bool[np.ndarray, " 6"]
    targets_rad: Float[np.ndarray, " 2"]

    @property
    def pair(self) -> str:
        """The edge in words."""
        return words_of(self.edge)

    @property
    def z(self) -> Float[np.ndarray, " 6"] | None:
        """The change in its sigmas."""
        return None if self.sigma is None else self.change / self.sigma


@dataclass(frozen=True, eq=False)
class Comparison:
    """One run (all pairs of one work key) against the truth."""

    method: str
    environment: str
    errors: dict[str, np.ndarray]  # pair or "loop" -> azimuth, elevation [rad], range [m]
    prior_errors: dict[str, np.ndarray]
    statuses: dict[str, str]
    normalised: np.ndarray  # error / sigma of every observable DoF of every pair
    # Angle [rad] and shift [m] of pairs estimated apart; the shift is None where they did not determine it.
    independent_loop: tuple[float, float | None] | None = None
    truth_spread: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # like errors: spread of one frame's picks
    truth_sigma: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # and what is left of it in the truth, 1 sigma


class ComparedRun(NamedTuple):
    """One run (records by pair), what it was compared with, and the result."""

    run: dict[str, CalibrationRecord]
    truth: dict[str, np.ndarray] | None
    picks: Picks | None
    comparison: Comparison
