"""Which parts of a long day are read: bursts of consecutive trios, spread over time, speed, turn and place.

A calibration takes some hundred frames, and the ones that come next in a drive show much the same. So the recorded time
is cut into equal parts; in the middle of each lies a burst that could be read, and of these those are read that show
most: a set is worth the sum over time, speed, turn and place of log(1 + bursts) in each class of it, and the burst
that adds most comes next (submodular, as the choice of frames in `calibrate/select/coverage.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.ingest.containers.timeline import Stretches

__all__ = ["BURST_TRIOS", "BurstMotion", "choose_bursts", "possible_bursts"]

# Tracks of moving clusters count from their second scan on (`calibrate/select/triggers.py`), and Doppler wraps are told
# apart within a few more; 20 scans are 2 s at 10 Hz, shorter than the blocks by which frames that judge are held out.
# Bursts of 10 were as good on a simulated day, and worse on the real one, whose sweeps come in clumps: more of them are
# missed by short stretches of time (50 sweeps of 80 planned, not 75).
BURST_TRIOS = 20
_CHOICE = 3  # as many bursts could be read as are, times this: each costs a glance at its odometry
# Classes: standing, creeping, city, main road, country road, motorway; turning right, bending, straight ...
_SPEEDS_MPS = np.array([1.0, 5.0, 10.0, 16.0, 25.0])
_YAW_RATES_RADPS = np.radians([-8.0, -2.0, 2.0, 8.0])
_TIE = 1e-3  # less than any difference in what bursts add
_PLACE_M = 200.0  # side of a place's cell: what a lidar sees in it is the same scene


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
    recorded: Stretches, sweeps: int, budget: int, *, is_motion_known: bool
) -> Int64[np.ndarray, "M 2"]:
    """First and last moment of each burst that could be read, in order of time.

    Args:
        recorded: log time in which sweeps were recorded.
        sweeps: number of them.
        budget: sweeps that shall be read.
        is_motion_known: False where nothing tells one burst from another: no more are asked for than are read.
    """
    spans = np.array(recorded.spans_ns, np.int64).reshape(-1, 2)
    before = np.concatenate([[0], np.cumsum(spans[:, 1] - spans[:, 0])])
    burst_ns = before[-1] * BURST_TRIOS / max(sweeps, 1)
    wanted = -(-budget // BURST_TRIOS) * (_CHOICE if is_motion_known else 1)
    count = max(1, min(wanted, int(before[-1] // max(burst_ns, 1))))
    middle = (np.arange(count) + 0.5) * before[-1] / count
    i = np.clip(np.searchsorted(before, middle, "right") - 1, 0, len(spans) - 1)
    start = spans[i, 0] + middle - before[i] - burst_ns / 2
    # A burst that would reach beyond its stretch is moved into it.
    start = np.maximum(np.minimum(start, spans[i, 1] - burst_ns), spans[i, 0])
    end = np.minimum(start + burst_ns, spans[i, 1])
    return np.stack([start, end], axis=1).astype(np.int64)


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
