"""A check of a calibration, passed from solvers and verification to the verdict and the record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from schemas.faults import FAULTS

__all__ = ["HARMLESS", "Change", "Check", "change_of", "faults_of"]

# Rotation vector and shift of the child's origin, both along the parent's axes [rad, m], as `rig.changes`.
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
