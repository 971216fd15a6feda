"""Selection of the parts of a long day to read: bursts of moments, spread over time, speed, turn and place.

A calibration takes about a hundred frames, and consecutive frames of a drive are similar. The day is divided
into parts with equal numbers of sweeps, with one possible burst in the middle of each. Bursts are then chosen
greedily to maximise the sum over classes of time, speed, turn and place of log(1 + bursts in the class). This
function is submodular, as in the choice of frames in `calibrate/select/coverage.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.ingest.containers.timeline import PAUSE_NS

__all__ = ["BURST_TRIOS", "BurstMotion", "PossibleBursts", "choose_bursts", "possible_bursts"]

# Tracks of moving clusters count from their second scan on (`calibrate/paper/triggers.py`), and Doppler
# aliases are resolved within a few more scans; 20 scans are 2 s at 10 Hz, shorter than the blocks of held-out
# frames. Bursts of 10 were as good on two simulated days of three, and one radar was held on the third.
BURST_TRIOS = 20
# If most sweeps are not part of 20 without a pause, tracks gain nothing, and more scenes are better: 80
# sweeps of the real day in runs of 20, 10 and 5 had a camera-lidar elevation error of 0.20, 0.04 and 0.01
# deg.
_CLUMP_TRIOS = 5
_CHOICE = 3  # possible bursts per burst to read; for each possible one, a short stretch of odometry is read
# Limits of classes: standing, creeping, city, main road, country road, motorway; turning right, bending,
# straight ...
_SPEEDS_MPS = np.array([1.0, 5.0, 10.0, 16.0, 25.0])
_YAW_RATES_RADPS = np.radians([-8.0, -2.0, 2.0, 8.0])
_TIE = 1e-3  # smaller than any real difference of the objective
_PLACE_M = 200.0  # side of a place's cell: a lidar sees the same scene within it


@dataclass(frozen=True, eq=False)
class PossibleBursts:
    """Bursts that can be read, in order of time: first and last moment, sweep in the middle, sweeps."""

    spans_ns: Int64[np.ndarray, "M 2"]
    middle_ns: Int64[np.ndarray, "M 3"]
    sweeps: int


@dataclass(frozen=True, eq=False)
class BurstMotion:
    """Motion of the car in the middle of each possible burst; NaN where it was not measured."""

    speed_mps: Float[np.ndarray, " M"]
    yaw_rate_radps: Float[np.ndarray, " M"]  # positive to the left
    position_m: Float[np.ndarray, "M 2"]  # in any frame that is constant for the day

    @classmethod
    def unknown(cls, count: int) -> BurstMotion:
        """Unknown motion for `count` bursts."""
        return cls(np.full(count, np.nan), np.full(count, np.nan), np.full((count, 2), np.nan))


def possible_bursts(
    sweeps_ns: Int64[np.ndarray, " N"], budget: int, *, is_motion_known: bool
) -> PossibleBursts:
    """Bursts that can be read, in order of time, all with the same number of sweeps.

    A burst is within a stretch without pauses if one is long enough. If most sweeps come in short groups,
    bursts are shorter: one group or several.

    Args:
        is_motion_known: False if bursts cannot be compared; then only as many are returned as will be read.
    """
    sweeps = len(sweeps_ns)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(sweeps_ns) > PAUSE_NS) + 1, [sweeps]])
    in_company = np.diff(edges)[np.diff(edges) >= BURST_TRIOS].sum()
    length = min(BURST_TRIOS if 2 * in_company >= sweeps else _CLUMP_TRIOS, sweeps)
    wanted = -(-budget // length) * (_CHOICE if is_motion_known else 1)
    count = max(1, min(wanted, sweeps // length))
    middle = ((np.arange(count) + 0.5) * sweeps / count).astype(np.int64)
    # Move a burst into its stretch if it reaches beyond it.
    stretch = np.searchsorted(edges, middle, "right") - 1
    begin, end = edges[stretch], edges[stretch + 1]
    is_long = end - begin >= length
    first = np.clip(
        middle - length // 2, np.where(is_long, begin, 0), np.where(is_long, end, sweeps) - length
    )
    last = first + length - 1
    gaps_ns = np.diff(sweeps_ns, prepend=sweeps_ns[0], append=sweeps_ns[-1])
    # Half-way to the neighbouring sweeps: the index gives the log time of a sweep only to within a chunk.
    reach_ns = np.minimum(gaps_ns // 2, PAUSE_NS)
    spans = np.stack([sweeps_ns[first] - reach_ns[first], sweeps_ns[last] + reach_ns[last + 1]], axis=1)
    around = sweeps_ns[np.clip(middle[:, None] + [-1, 0, 1], 0, sweeps - 1)]
    return PossibleBursts(spans, around, length)


def choose_bursts(motion: BurstMotion, count: int) -> list[int]:
    """The `count` best bursts as a set, in order of time; all of them if there are no more."""
    classes = _classes(motion, count)
    possible, kinds = classes.shape
    if possible <= count:
        return list(range(possible))
    seen = np.zeros((kinds, int(classes.max()) + 1))
    left, places, chosen = np.ones(possible, bool), np.arange(possible), list[int]()
    for _ in range(count):
        known = seen[np.arange(kinds), np.maximum(classes, 0)]
        gain = np.where(classes >= 0, np.log1p(1 / (1 + known)), 0.0).sum(axis=1)
        # Ties are resolved by the largest distance in time from the chosen bursts.
        apart = np.abs(np.subtract.outer(places, chosen)).min(axis=1, initial=possible) / possible
        best = int(np.argmax(np.where(left, gain + _TIE * apart, -1.0)))
        chosen.append(best)
        left[best] = False
        there = np.flatnonzero(classes[best] >= 0)
        seen[there, classes[best, there]] += 1
    return sorted(chosen)


def _classes(motion: BurstMotion, count: int) -> Int64[np.ndarray, "M 4"]:
    """Class of each burst in time, speed, turn and place; -1 if unknown."""
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
