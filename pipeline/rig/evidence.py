"""Result of one edge without the prior: the input of the rig's adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.rig.checks import Check
from pipeline.rig.estimates import DayParts
from pipeline.rig.graph import Edge

__all__ = ["EDGE", "EdgeEvidence", "OtherScenes"]

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
