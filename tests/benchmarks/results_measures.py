"""How a row of the result table computes its number from result lines, each by a name that rows.toml uses.

A measure takes the chosen lines and the row, and returns the text of the cell. Rates come with a 95 % interval over
what is independent: days, never records, for the three records of a day share their frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, t

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.metrics import within
from tests.benchmarks.studies.run import FOUND_DEG

__all__ = ["MEASURES", "interval", "rate"]

Lines = Sequence[Mapping[str, Any]]
Row = Mapping[str, Any]


def errors(lines: Lines, row: Row) -> str:
    """Mean errors of `pairs`, azimuth / elevation [deg], and the half-widths of their intervals over days."""
    cells = []
    for pair in row.get("pairs", PAIRS):
        found = [r["pairs"][pair] for r in lines if "az_deg" in r["pairs"].get(pair, {})]
        angles = np.array([(p["az_deg"], p["el_deg"]) for p in found])
        half = t.ppf(0.975, len(found) - 1) * angles.std(axis=0, ddof=1) / np.sqrt(len(found))
        mean, wide = ("/".join(f"{v:.3f}" for v in values) for values in (angles.mean(axis=0), half))
        cells.append(f"{mean} (+- {wide})")
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
    return rate(sum(good), len(good))


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


def found(lines: Lines, row: Row) -> str:
    """Runs of each of `rows` whose camera-lidar is within .15 deg, and those in which it was accepted."""
    by_row = [[r["pairs"].get("camera_lidar", {}) for r in lines if r["row"] == name] for name in row["rows"]]
    near = [sum(max(p["az_deg"], p["el_deg"]) <= FOUND_DEG for p in own if "az_deg" in p) for own in by_row]
    taken = [sum(p.get("status") == "accepted" for p in own) for own in by_row]
    return f"{_slashed(near)}; {_slashed(taken)} of {len(by_row[0])}"


def wrong_records(lines: Lines, _row: Row) -> str:
    """Accepted records with an angle that they certify beyond its limit, of all that were accepted."""
    records = [(pair, p) for r in lines for pair, p in r["pairs"].items()]
    accepted = [(pair, p) for pair, p in records if p["status"] == "accepted"]
    wrong = sum(not within(pair, p, claimed=True) for pair, p in accepted)
    return f"{wrong} of {len(accepted)} accepted ({len(records)} records)"


def nights_wrong(lines: Lines, _row: Row) -> str:
    """Certified records, poses and states of fleets that are wrong, of all that certify a direction."""
    counts = []
    for what in ("records", "poses", "states"):
        every = [x for r in lines for x in r[what] if x["certified"]]
        counts.append(f"{sum(x['is_wrong'] for x in every)} of {len(every)} {what}")
    return ", ".join(counts)


def states_after(lines: Lines, row: Row) -> str:
    """Sensors whose state certifies a direction after each of `nights`, those that were run; the last as a rate."""
    shares = []
    for night in row["nights"]:
        states = [s for r in lines if r["night"] == night - 1 for s in r["states"]]
        if states:
            shares.append((sum(bool(s["certified"]) for s in states), len(states)))
    return ", ".join([*(f"{hits}/{trials}" for hits, trials in shares[:-1]), rate(*shares[-1])])


def named_red(lines: Lines, _row: Row) -> str:
    """Moved sensors that audit names RED, and vehicles that are RED for another reason."""
    moved = {(r["row"], r["vehicle"]) for r in lines if r["moved"] and r["night"] >= r["moved"][1]}
    named = {
        (r["row"], r["vehicle"])
        for r in lines
        if r["moved"] and r["moved"][0] in r["red"] and r["night"] >= r["moved"][1]
    }
    early = {
        (r["row"], r["vehicle"]) for r in lines if r["red"] and (not r["moved"] or r["night"] < r["moved"][1])
    }
    return f"{rate(len(named), len(moved))}; {len(early)} others RED" if moved else "none moved"


def cents(lines: Lines, row: Row) -> str:
    """Price of the CPU time of a vehicle-day, from logs to pages, by fleet."""
    cells = []
    for name in dict.fromkeys(r["row"] for r in lines):
        cpu_s = float(np.mean([r["cpu_s"] for r in lines if r["row"] == name]))
        cells.append(f"{name} {cpu_s / 3600 * row['cents_per_core_hour']:.2f} ({cpu_s:.0f} CPU s)")
    return ", ".join(cells)


def ageing(lines: Lines, _row: Row) -> str:
    """CPU seconds of a fleet's audit and states after its nights, and with a year of them."""
    return ", ".join(
        f"{young:.0f} CPU s; after a year {old:.0f}" for young, old in (r["cpu_s"] for r in lines)
    )


def step_s(lines: Lines, _row: Row) -> str:
    """CPU seconds of a step of training, and minutes of the training, start and validation included."""
    cost = max(r["cpu_s_a_step"] for r in lines)
    return f"{cost:.2f} CPU s a step, {lines[0]['steps'] * cost / 60:.0f} minutes"


def _slashed(numbers: Sequence[int]) -> str:
    return "/".join(map(str, numbers))


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


_ALL = (
    accepted_days, ageing, cents, errors, found, inside, named_red, nights_wrong, states_after, step_s, wrong_days,
    wrong_records,
)  # fmt: skip
MEASURES: dict[str, Callable[[Lines, Row], str]] = {f.__name__: f for f in _ALL}
