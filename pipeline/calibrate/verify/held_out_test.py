"""Alignment of held-out frames at the prior and at the result: a paired test over blocks of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtri, stdtr

__all__ = ["HeldOutTest", "paired_test"]


@dataclass(frozen=True)
class HeldOutTest:
    """Mean cost at the prior and at the result, over frames that have both, and how sure the difference is."""

    before: float
    after: float
    standard_error: float  # of after - before, from the scatter of blocks
    frames: int
    blocks: int

    @property
    def z(self) -> float:
        """Significance of after - before as a normal deviate: negative = better aligned, 0 where nothing changed.

        Student's t with one degree of freedom less than blocks, converted to the normal deviate of the same
        probability: two blocks that agree by chance are no 30-sigma proof. Within +-8.
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
    """Compare the costs of the same frames at two calibrations.

    Frames with a cost that is not finite at either calibration are left out. The standard error treats
    blocks, not frames, as independent; with a single block, frames do.

    Args:
        before: cost of each frame at the prior (lower is better).
        after: the same at the result.
        blocks: frames of equal number share a scene.

    Returns:
        The test, or None where no frame has both costs.
    """
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    before, after, blocks = before[both], after[both], blocks[both]
    difference = after - before
    names, index = np.unique(blocks, return_inverse=True)
    if len(names) == 1:
        names, index = np.arange(len(difference)), np.arange(len(difference))
    # Deviations summed over blocks: Var(mean) = sum_b (sum_{f in b} (d_f - mean))^2 / F^2, small-sample
    # factor B/(B-1).
    sums = np.bincount(index, difference - difference.mean(), minlength=len(names))
    scale = len(names) / (len(names) - 1) if len(names) > 1 else 1.0
    error = float(np.sqrt(scale * np.sum(sums**2)) / len(difference))
    return HeldOutTest(float(before.mean()), float(after.mean()), error, len(difference), len(names))
