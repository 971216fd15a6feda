"""Rates of few trials, with what their number allows."""

from __future__ import annotations

from scipy.stats import beta

__all__ = ["interval", "rate"]

_CONFIDENCE = 0.95


def interval(hits: int, trials: int) -> tuple[float, float]:
    """Clopper and Pearson's 95 % interval of a rate; one-sided if none or all succeed (about 3 / trials wide)."""
    if not 0 <= hits <= trials or trials < 1:
        raise ValueError(f"{hits} of {trials} is no rate")
    outside = 1 - _CONFIDENCE if hits in {0, trials} else (1 - _CONFIDENCE) / 2
    low = float(beta.ppf(outside, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - outside, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def rate(hits: int, trials: int) -> str:
    """`k of n (low to high %)`."""
    low, high = (100 * end for end in interval(hits, trials))
    if hits == 0:
        return f"{hits} of {trials} (< {high:.1f} %)"
    if hits == trials:
        return f"{hits} of {trials} (> {low:.1f} %)"
    return f"{hits} of {trials} ({low:.0f} to {high:.0f} %)"
