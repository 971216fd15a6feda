"""Rates of few trials, with what their number allows."""

from __future__ import annotations

from pipeline.verify.rates import interval

__all__ = ["interval", "rate"]


def rate(hits: int, trials: int) -> str:
    """`k of n (low to high %)`."""
    low, high = (100 * end for end in interval(hits, trials))
    if hits == 0:
        return f"{hits} of {trials} (< {high:.1f} %)"
    if hits == trials:
        return f"{hits} of {trials} (> {low:.1f} %)"
    return f"{hits} of {trials} ({low:.0f} to {high:.0f} %)"
