"""Which parts of a long day are read: bursts of consecutive moments, spread over time, speed, turn and place.

A calibration takes some hundred frames, and the ones that come next in a drive show much the same. So the day is cut
into parts of equally many sweeps; in the middle of each lies a burst that could be read, and of these those are read
that show most: a set is worth the sum over time, speed, turn and place of log(1 + bursts) in each class of it, and the
burst that adds most comes next (submodular, as the choice of frames in `calibrate/select/coverage.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.ingest.containers.timeline import PAUSE_NS

__all__ = ["BURST_TRIOS", "BurstMotion", "PossibleBursts", "choose_bursts", "possible_bursts"]

# Tracks of moving clusters count from their second scan on (`calibrate/select/triggers.py`), and Doppler wraps are told
# apart within a few more; 20 scans are 2 s at 10 Hz, shorter than the blocks by which frames that judge are held out.
# Bursts of 10 were as good on two simulated days of three, and had a radar held on one.
BURST_TRIOS = 20
# Where most sweeps have no 20 about them without a pause, there are no tracks to gain, and more scenes are worth
# more: 80 sweeps of the real day in runs of 20, 10 and 5 had camera-lidar 0.20, 0.04 and 0.01 deg off in elevation.
_CLUMP_TRIOS = 5
_CHOICE = 3  # as many bursts could be read as are, times this: each costs a glance at its odometry
# Classes: standing, creeping, city, main road, country road, motorway; turning right, bending, straight ...
_SPEEDS_MPS = np.array([1.0, 5.0, 10.0, 16.0, 25.0])
_YAW_RATES_RADPS = np.radians([-8.0, -2.0, 2.0, 8.0])
_TIE = 1e-3  # less than any difference in what bursts add
_PLACE_M = 200.0  # side of a place's cell: what a lidar sees in it is the same scene


@dataclass(frozen=True, eq=False)
class PossibleBursts:
    """Bursts that could be read, in order of time.

    Args:
        spans_ns: first and last moment of each.
        middle_ns: its middle sweep, with the sweeps before and after that one.
        sweeps: how many each holds.
    """

    spans_ns: Int64[np.ndarray, "M 2"]
    middle_ns: Int64[np.ndarray, "M 3"]
    sweeps: int


@dataclass(frozen=True, eq=False)
class BurstMotion:
    """How the car moves in the middle of each possible burst; NaN where nobody measured it."""

    speed_mps: Float[np.ndarray, " M"]
    yaw_rate_radps: Float[np.ndarray, " M"]  # positive to the left
    position_m: Float[np.ndarray, "M 2"]  # in any frame that stays the same for the day

    @classmethod
    def unknown(cls, count: int) -> BurstMotion:
        """Of so many bursts, nothing."""
        return cls(np.full(count, np.nan), np.full(count, np.nan), np.full((count, 2), np.nan))


def possible_bursts(
    sweeps_ns: Int64[np.ndarray, " N"], budget: int, *, is_motion_known: bool
) -> PossibleBursts:
    """The bursts that could be read, in order of time: of as many sweeps, wherever these lie.

    Within a stretch without pause, where one is long enough; where most sweeps come in clumps, bursts are shorter, of a
    clump or several.

    Args:
        sweeps_ns: when each was logged, as far as the index tells; in order.
        budget: sweeps that shall be read.
        is_motion_known: False where nothing tells one burst from another: no more are asked for than are read.
    """
    sweeps = len(sweeps_ns)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(sweeps_ns) > PAUSE_NS) + 1, [sweeps]])
    in_company = np.diff(edges)[np.diff(edges) >= BURST_TRIOS].sum()
    length = min(BURST_TRIOS if 2 * in_company >= sweeps else _CLUMP_TRIOS, sweeps)
    wanted = -(-budget // length) * (_CHOICE if is_motion_known else 1)
    count = max(1, min(wanted, sweeps // length))
    middle = ((np.arange(count) + 0.5) * sweeps / count).astype(np.int64)
    # A burst that would reach beyond its stretch is moved into it.
    stretch = np.searchsorted(edges, middle, "right") - 1
    begin, end = edges[stretch], edges[stretch + 1]
    is_long = end - begin >= length
    first = np.clip(
        middle - length // 2, np.where(is_long, begin, 0), np.where(is_long, end, sweeps) - length
    )
    last = first + length - 1
    gaps_ns = np.diff(sweeps_ns, prepend=sweeps_ns[0], append=sweeps_ns[-1])
    # Half-way to the sweeps beside it: an index knows only to within a chunk when a sweep was logged.
    reach_ns = np.minimum(gaps_ns // 2, PAUSE_NS)
    spans = np.stack([sweeps_ns[first] - reach_ns[first], sweeps_ns[last] + reach_ns[last + 1]], axis=1)
    around = sweeps_ns[np.clip(middle[:, None] + [-1, 0, 1], 0, sweeps - 1)]
    return PossibleBursts(spans, around, length)


def choose_bursts(motion: BurstMotion, count: int) -> list[int]:
    """The `count` bursts that together show most, in order of time; all where there are no more.

    Args:
        motion: of the possible bursts, in order of time.
        count: how many are to be read.
    """
    classes = _classes(motion, count)
    possible, kinds = classes.shape
    if possible <= count:
        return list(range(possible))
    seen = np.zeros((kinds, int(classes.max()) + 1))
    left, places, chosen = np.ones(possible, bool), np.arange(possible), list[int]()
    for _ in range(count):
        known = seen[np.arange(kinds), np.maximum(classes, 0)]
        gain = np.where(classes >= 0, np.log1p(1 / (1 + known)), 0.0).sum(axis=1)
        # Of equals the one furthest in time from those chosen.
        apart = np.abs(np.subtract.outer(places, chosen)).min(axis=1, initial=possible) / possible
        best = int(np.argmax(np.where(left, gain + _TIE * apart, -1.0)))
        chosen.append(best)
        left[best] = False
        there = np.flatnonzero(classes[best] >= 0)
        seen[there, classes[best, there]] += 1
    return sorted(chosen)


def _classes(motion: BurstMotion, count: int) -> Int64[np.ndarray, "M 4"]:
    """Class of each burst in time, speed, turn and place; -1 where it is unknown."""
    possible = len(motion.speed_mps)
    speed = np.searchsorted(_SPEEDS_MPS, np.abs(motion.speed_mps))
    turn = np.searchsorted(_YAW_RATES_RADPS, motion.yaw_rate_radps)
    cell = np.floor(np.nan_to_num(motion.position_m) / _PLACE_M)
    place = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)
    return np.stack(
        [
            np.arange(possible) * count // max(possible, 1),
            np.where(np.isnan(motion.speed_mps), -1, speed),
            np.where(np.isnan(motion.yaw_rate_radps), -1, turn),
            np.where(np.isnan(motion.position_m).any(axis=1), -1, place),
        ],
        axis=1,
    ).astype(np.int64)
