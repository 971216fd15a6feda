"""The k-th smallest of a few values, for compiled code: no sorting, no copies."""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["kth_smallest", "median_of"]


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def kth_smallest(value: np.ndarray, count: int, k: int) -> float:
    """Value number k (from 0) in order of size among the first `count`, whose order changes.

    Source: Hoare 1961, "Algorithm 65: find".
    """
    low, high = 0, count - 1
    while low < high:
        pivot = value[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while value[i] < pivot:
                i += 1
            while pivot < value[j]:
                j -= 1
            if i <= j:
                value[i], value[j] = value[j], value[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return value[k]


@no_type_check
@numba.njit(cache=True)
def median_of(value: np.ndarray, count: int) -> float:
    """Median of the first `count` values, whose order changes; of an even number the mean of the middle two."""
    upper = kth_smallest(value, count, count // 2)
    if count % 2 == 1:
        return upper
    # What lies before the upper middle is not larger.
    lower = value[0]
    for i in range(1, count // 2):
        lower = max(lower, value[i])
    return (lower + upper) / 2
