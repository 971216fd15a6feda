"""Alignment of held-out frames at the prior and at the result: a paired test over scenes of equal weight.

A standing car logs one scene many times: 13 of 40 held-out frames of the real day are from two seconds. With
equal weights of frames, they alone rejected a result that improved every other scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtri, stdtr

__all__ = ["HeldOutTest", "paired_test"]


@dataclass(frozen=True)
class HeldOutTest:
    """Mean over blocks of the cost at the prior and at the result, of frames with both, and its significance."""

    before: float
    after: float
    standard_error: float  # of after - before, from the scatter of blocks
    frames: int
    blocks: int

    @property
    def z(self) -> float:
        """Significance of after - before as a normal deviate: negative = better aligned, 0 where nothing changed.

        Student's t with one degree of freedom less than blocks is converted to the normal deviate of the same
        probability, so that a chance agreement of two blocks is not a 30-sigma result. Limited to +-8.
        """
        difference = self.after - self.before
        if difference == 0:
            return 0.0
        ratio = abs(difference) / self.standard_error if self.standard_error > 0 else np.inf
        tail = max(float(stdtr(max(self.blocks - 1, 1), -ratio)), 1e-15)
        return float(-np.sign(difference) * ndtri(tail))


def paired_test(
    before: Float[np.ndarray, " F"], after: Float[np.ndarray, " F"], blocks: Int[np.ndarray, " F"]
) -> HeldOutTest | None:
    """Compare the costs of the same frames at two calibrations (lower is better); None without frames.

    Frames with a cost that is not finite are left out. Blocks (scenes), not frames, are independent and count
    once each, by their mean; a single block counts by its frames.
    """
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    before, after, blocks = before[both], after[both], blocks[both]
    names, index = np.unique(blocks, return_inverse=True)
    if len(names) == 1:
        names, index = np.arange(len(before)), np.arange(len(before))
    frames, B = np.bincount(index), len(names)
    before, after = np.bincount(index, before) / frames, np.bincount(index, after) / frames
    error = float(np.std(after - before, ddof=1) / np.sqrt(B)) if B > 1 else 0.0
    return HeldOutTest(float(before.mean()), float(after.mean()), error, int(both.sum()), B)
