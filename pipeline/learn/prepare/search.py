"""Assignment of every vehicle, day and place to a side, with the largest worth and few lost frames.

A frame is kept if all of its keys are on one side. The worth of an assignment is the sum over the sides of
    share * ln(frames)
Any assignment with an empty side is worth less than one without. If all frames can be kept, the sides get the
requested shares. If every cut loses frames, doubling the validation frames is worth 8 % of the training
frames (share 0.1 against 0.8).

The best assignment is a graph cut with more than two sides (NP-hard), so it is found by a search. All keys of
a kind move to their best side in turn (their frames do not depend on one another), until nothing changes.
Then frames are moved to another side with all of their keys, and gains are kept. On small fleets, the search
finds the same result as an exhaustive search (tests/learn/prepare/test_split.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["Cut", "search_sides", "worth"]

# Random starts beside those given; looks = starts x pulls x units. Of 300 fleets of up to nine vehicle-days that share
# places, 30 starts missed the best assignment of some, these of none (10 ms each); 30,000 vehicle-days take 2 to 4 s.
_STARTS, _LEAST_PULLS = 150, 100
_LEAST_LOOKS, _LOOKS_PER_UNIT, _MOST_LOOKS = 40_000, 1000, 3_000_000
_GAIN = 1e-9  # rounding of a sum of logarithms lies far below


@dataclass(frozen=True)
class Cut:
    """Units to divide. Keys are numbered; kinds (vehicle, day, place) are columns."""

    unit_keys: Int[np.ndarray, "N K"]  # key of each unit by kind; -1 = a key that no other unit has
    frames: Int[np.ndarray, " N"]
    shares: Float[np.ndarray, " S"]  # wanted, all above 0
    fixed: Bool[np.ndarray, " M"]  # keys whose side must stay


def worth(frames: Float[np.ndarray, " S"], shares: Float[np.ndarray, " S"], total: int) -> float:
    """Worth of an assignment from the frames kept on each side, out of `total`."""
    return float(_worth(frames, shares, total))


def search_sides(cut: Cut, starts: Sequence[Int[np.ndarray, " M"]], seed: int) -> Int[np.ndarray, " M"]:
    """The best sides found from any of the `starts`; among equal ones, earlier sides get more frames.

    The same input gives the same result. `starts` has the side of every key; fixed keys are the same in all.
    """
    problem = (cut.unit_keys, cut.frames, cut.shares)
    rng = np.random.default_rng(seed)
    pulls = _pulls(cut, rng)
    more = min(_STARTS, _looks(cut) // (len(pulls) * len(cut.frames)))
    drawn = rng.integers(0, len(cut.shares), (more, len(cut.fixed)))
    every = [*starts, *np.where(cut.fixed, starts[0], drawn)]
    ends = [_pull(*problem, cut.fixed, start.copy(), pulls) for start in every]
    kept = [_frames(*problem, sides) for sides in ends]
    values = [round(worth(frames, cut.shares, int(cut.frames.sum())), 9) for frames in kept]
    return ends[max(range(len(ends)), key=lambda i: (values[i], *kept[i]))]


def _looks(cut: Cut) -> int:
    return max(_LEAST_LOOKS, min(_MOST_LOOKS, _LOOKS_PER_UNIT * len(cut.frames)))


def _pulls(cut: Cut, rng: np.random.Generator) -> Int[np.ndarray, "P 2"]:
    """Units and sides in random order: all of them, or a limited number for a large fleet."""
    count = len(cut.frames) * len(cut.shares)
    wanted = max(_LEAST_PULLS, min(count, _looks(cut) // len(cut.frames)))
    drawn = np.concatenate([rng.permutation(count) for _ in range(-(-wanted // count))])[:wanted]
    return np.stack([drawn // len(cut.shares), drawn % len(cut.shares)], axis=1)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _pull(
    unit_keys: np.ndarray,
    frames: np.ndarray,
    shares: np.ndarray,
    fixed: np.ndarray,
    sides: np.ndarray,
    pulls: np.ndarray,
) -> np.ndarray:
    """Move units to other sides with all their keys, and keep gains, until no move gains."""
    total = frames.sum()
    _climb(unit_keys, frames, shares, fixed, sides)
    value = _worth(_frames(unit_keys, frames, shares, sides), shares, total)
    failed = 0
    for unit, side in pulls:
        failed += 1
        if failed > len(frames) * len(shares):
            break
        trial, held = sides.copy(), fixed.copy()
        for key in unit_keys[unit]:
            if key >= 0 and not fixed[key]:
                trial[key] = side
                held[key] = True
        _climb(unit_keys, frames, shares, held, trial)
        _climb(unit_keys, frames, shares, fixed, trial)
        found = _worth(_frames(unit_keys, frames, shares, trial), shares, total)
        if found > value + _GAIN:
            sides, value, failed = trial, found, 0
    return sides


@no_type_check
@numba.njit(cache=True)
def _climb(
    unit_keys: np.ndarray, frames: np.ndarray, shares: np.ndarray, held: np.ndarray, sides: np.ndarray
) -> None:
    """Move each free key to its best side, kind by kind, until none moves; modifies `sides`."""
    total = frames.sum()
    now = _frames(unit_keys, frames, shares, sides)
    moved = True
    while moved:
        moved = False
        for kind in range(unit_keys.shape[1]):
            with_side = _frames_by_key(unit_keys, frames, shares, sides, kind)
            for key in range(len(sides)):
                if held[key] or with_side[key].sum() == with_side[key, sides[key]]:
                    continue  # nothing to gain elsewhere
                now[sides[key]] -= with_side[key, sides[key]]
                best, value = sides[key], -np.inf
                for step in range(len(shares)):
                    side = (sides[key] + step) % len(shares)  # the present one first: it wins a tie
                    now[side] += with_side[key, side]
                    found = _worth(now, shares, total)
                    now[side] -= with_side[key, side]
                    if found > value + _GAIN:
                        best, value = side, found
                moved |= best != sides[key]
                sides[key] = best
                now[best] += with_side[key, best]


@no_type_check
@numba.njit(cache=True)
def _frames_by_key(
    unit_keys: np.ndarray, frames: np.ndarray, shares: np.ndarray, sides: np.ndarray, kind: int
) -> np.ndarray:
    """Frames (M S) that each key of a kind would keep on each side, with other kinds unchanged."""
    out = np.zeros((len(sides), len(shares)))
    for unit in range(len(frames)):
        own = unit_keys[unit, kind]
        if own >= 0:
            low, high = _extremes(unit_keys[unit], sides, len(shares), kind)
            for side in range(max(0, high), min(len(shares), low + 1)):
                out[own, side] += frames[unit]
    return out


@no_type_check
@numba.njit(cache=True)
def _frames(unit_keys: np.ndarray, frames: np.ndarray, shares: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Frames (S) that each side keeps."""
    out = np.zeros(len(shares))
    for unit in range(len(frames)):
        low, high = _extremes(unit_keys[unit], sides, len(shares), -1)
        if low == high:
            out[low] += frames[unit]
    return out


@no_type_check
@numba.njit(cache=True)
def _extremes(keys: np.ndarray, sides: np.ndarray, count: int, without: int) -> tuple[int, int]:
    """Lowest and highest side among a unit's keys except one kind's; `count` and -1 if none."""
    low, high = count, -1
    for kind in range(len(keys)):
        if kind != without and keys[kind] >= 0:
            side = sides[keys[kind]]
            low, high = min(low, side), max(high, side)
    return low, high


@no_type_check
@numba.njit(cache=True)
def _worth(frames: np.ndarray, shares: np.ndarray, total: int) -> float:
    out = 0.0
    for side in range(len(shares)):
        if frames[side] > 0:
            out += shares[side] * np.log(frames[side])
        else:
            out -= 1 + np.log(total)  # more than all other sides together can gain
    return out
