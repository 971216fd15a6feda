"""What the data of one edge show, without any prior: what edges hand over to the adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.extrinsics.checks import FailedCheck
from pipeline.rig.graph import Edge

__all__ = ["EDGE", "EdgeEvidence"]

EDGE = "edge"  # owner of a bias that is the edge's own: how its two sensors are matched


@dataclass(frozen=True, eq=False)
class EdgeEvidence:
    """A quadratic cost of one edge around T: 1/2 x' information x - gradient' x, with x = (xi, dt).

    xi is the left perturbation T_parent_child <- exp(xi) T [rad, m] in the parent's axes, dt [s] is the child's clock
    against the parent's: stamp_parent = stamp_child + dt_s + dt. What the day does not show has no information.

    Args:
        edge: whose data.
        T: T_parent_child where the cost is linearised.
        dt_s: the clock where it is.
        information: 7 7, of the data alone, robust (the spread over scenes is in it).
        gradient: 7, descent: the data alone would move by information^-1 gradient.
        bias: covariance 6 6 of what all frames err by alike, by owner: a sensor's name (its intrinsics, its elevation;
            in that sensor's own axes, as a twist by which it seems to be turned), or EDGE (in the parent's axes).
        frames_used: frames that it rests on.
        frames_rejected: frames that it does not, by reason.
        checks: of its own that failed: basin, halves, held-out frames. Such an edge is left out of the adjustment.
        diagnostics: numbers behind it, names with units.
        notes: what a reader should know.
    """

    edge: Edge
    T: np.ndarray
    dt_s: float
    information: np.ndarray
    gradient: np.ndarray
    bias: Mapping[str, np.ndarray] = field(default_factory=dict)
    frames_used: int = 0
    frames_rejected: Mapping[str, int] = field(default_factory=dict)
    checks: tuple[FailedCheck, ...] = ()
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert self.T.shape == (4, 4)
        assert self.information.shape == (7, 7)
        assert self.gradient.shape == (7,)
        owners = {EDGE, *(s.name for s in self.edge.sensors)}
        assert set(self.bias) <= owners, f"{self.edge.name} has biases of {set(self.bias) - owners}"
