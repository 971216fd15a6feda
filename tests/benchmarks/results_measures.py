"""How a row of the result table computes its number from result lines, each by a name that rows.toml uses.

A measure takes the chosen lines and the row, and returns the text of the cell. Rates come with a 95 % interval over
what is independent: days, never records, for the three records of a day share their frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.metrics import within

__all__ = ["MEASURES", "interval", "rate"]

Lines = Sequence[Mapping[str, Any]]
Row = Mapping[str, Any]


def errors(lines: Lines, row: Row) -> str:
    """Mean errors of `pairs`: azimuth / elevation [deg], and with `range = true` / range [m]."""
    names = ["az_deg", "el_deg", *(["range_m"] if row.get("range") else [])]
    cells = []
    for pair in row.get("pairs", PAIRS):
        found = [r["pairs"][pair] for r in lines if "az_deg" in r["pairs"].get(pair, {})]
        cells.append("/".join(f"{np.mean([p[name] for p in found]):.3f}" for name in names))
    return ", ".join(cells)


def wrong_days(lines: Lines, _row: Row) -> str:
    """Days on which a record was accepted with an angle that it certifies beyond its limit."""
    days: dict[tuple[str, ...], bool] = {}
    for r in lines:
        key = tuple(str(r["day"][name]) for name in ("rig", "environment", "seed"))
        accepted = [(pair, p) for pair, p in r["pairs"].items() if p["status"] == "accepted"]
        days[key] = days.get(key, False) or any(not within(pair, p, claimed=True) for pair, p in accepted)
    return rate(sum(days.values()), len(days))


def accepted_days(lines: Lines, row: Row) -> str:
    """Days on which every pair of `pairs` was accepted."""
    pairs = row.get("pairs", PAIRS)
    good = [all(r["pairs"].get(pair, {}).get("status") == "accepted" for pair in pairs) for r in lines]
    return f"{rate(sum(good), len(good))}{row.get('unit', '')}"


def inside(lines: Lines, _row: Row) -> str:
    """Share of determined degrees of freedom within 1 and 3 sigma; the interval is of days' own shares."""
    days = []
    for r in lines:
        known = [p for p in r["pairs"].values() if "error" in p]
        seen = np.concatenate([np.array(p["observable"], bool) for p in known])
        error, sigma = (np.concatenate([np.array(p[key]) for p in known]) for key in ("error", "sigma"))
        days.append((np.abs(error) / sigma)[seen])
    shares = np.array([np.mean(z <= 1) for z in days])
    half = 196 * shares.std(ddof=1) / np.sqrt(len(days))
    all_within = sum(bool((z <= 3).all()) for z in days)
    one = 100 * np.mean(np.concatenate(days) <= 1)
    return f"{one:.0f} % (+- {half:.0f}); in three: {rate(all_within, len(days))}"


def clock_sigmas(lines: Lines, row: Row) -> str:
    """Time offsets of `pairs` within three of their sigmas, and their error in sigmas (RMS)."""
    records = [r["pairs"].get(pair, {}) for r in lines for pair in row["pairs"]]
    known = [p for p in records if p.get("dt_s") is not None]
    z = np.array([(p["dt_s"] - p["dt_true_s"]) / p["dt_sigma_s"] for p in known])
    return f"{rate(int(np.sum(np.abs(z) <= 3)), len(z))}, {np.sqrt(np.mean(z**2)):.2f} sigma"


def interval(hits: int, trials: int) -> tuple[float, float]:
    """Clopper and Pearson's 95 % interval of a rate; one-sided if none or all succeed (about 3 / trials wide)."""
    if not 0 <= hits <= trials or trials < 1:
        raise ValueError(f"{hits} of {trials} is no rate")
    outside = 0.05 if hits in {0, trials} else 0.025
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


MEASURES: dict[str, Callable[[Lines, Row], str]] = {
    f.__name__: f for f in (accepted_days, clock_sigmas, errors, inside, wrong_days)
}
