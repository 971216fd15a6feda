"""Synchronisation of a rig's captures: stamps in, indices out, without decoding."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np
from jaxtyping import Bool, Int, Int64

from schemas.moments import SAME_SCENE_NS

__all__ = [
    "WRONG_UNIT", "Matched", "Rejection", "constant_gap_ns", "first_occurrences", "match_moments",
    "match_nearest", "nearest_gaps_ns", "none_near", "number_drives",
]  # fmt: skip

_DRIVE_GAP_NS = 10 * 10**9
_HALF_A_PERIOD = 0.55  # half a period, and a tenth of it for jitter
# Length of the mean of the gaps on the circle of a period, if they scatter by a tenth of it (one sigma).
_TRIGGERED = 0.8


class Rejection(StrEnum):
    """Reasons why a sweep became no moment; a sweep is kept, or counted by reason or missing sensor.

    For a moment kept without a sensor, the sensor's reason is counted as `without_SENSOR_REASON`.
    """

    DUPLICATE_STAMP = "duplicate_stamp"
    NO_LIDAR = "no_lidar_all_day"
    NOT_PICKED = "beyond_max_frames"
    IMAGE_DAMAGED = "image_damaged"
    IMAGE_SIZE = "image_size_differs_from_camera_info"
    CAMERA_INFO = "no_usable_camera_info"
    LIDAR_DAMAGED = "lidar_undecodable"
    LIDAR_SPARSE = "too_few_lidar_points"
    LIDAR_UNIT = "lidar_points_in_another_unit"
    RADAR_DAMAGED = "radar_undecodable"
    RADAR_SPARSE = "too_few_radar_points"
    RADAR_UNIT = "radar_points_in_another_unit"
    IMAGE_REPEATED = "image_repeats_an_earlier_one"
    LIDAR_REPEATED = "lidar_repeats_an_earlier_sweep"
    RADAR_REPEATED = "radar_repeats_an_earlier_scan"


WRONG_UNIT: Final = {"lidar": Rejection.LIDAR_UNIT, "radar": Rejection.RADAR_UNIT}


@dataclass(frozen=True, eq=False)
class Matched:
    """Indices into the stamp lists, in order of the anchor's stamp, and counts of anchors without partner.

    `len(anchor) + sum(rejected.values())` is the number of anchors.

    Args:
        others: by sensor, -1 if a moment does not have it.
    """

    anchor: Int64[np.ndarray, " N"]
    others: Mapping[str, Int64[np.ndarray, " N"]]
    rejected: Counter[str] = field(default_factory=Counter)


def none_near(sensor: str) -> str:
    """Name of the count of anchors without a near capture of a sensor."""
    return f"no_{sensor}_in_gate"


def first_occurrences(stamps_ns: Int[np.ndarray, " N"]) -> Int64[np.ndarray, " M"]:
    """Indices of distinct stamps in order of time; of equal stamps the first one logged."""
    return np.unique(stamps_ns, return_index=True)[1].astype(np.int64)


def match_nearest(
    a_ns: Int[np.ndarray, " N"], b_ns: Int[np.ndarray, " M"], gate_ns: int
) -> Int64[np.ndarray, " N"]:
    """For each stamp of a, the index of its partner in b within the gate, else -1; each b is used once.

    If two want the same b, the nearer one gets it (the earlier one if equally near); the other gets its next
    nearest free b.
    """
    partner = np.full(len(a_ns), -1, np.int64)
    if not len(a_ns) or not len(b_ns):
        return partner
    order_b = np.argsort(b_ns, kind="stable")
    sorted_b = b_ns[order_b].astype(np.int64)
    low = np.searchsorted(sorted_b, a_ns - gate_ns, "left")
    high = np.searchsorted(sorted_b, a_ns + gate_ns, "right")
    count = high - low
    i = np.repeat(np.arange(len(a_ns)), count)
    j = np.arange(len(i)) + np.repeat(low - np.cumsum(count) + count, count)
    gap = np.abs(a_ns[i].astype(np.int64) - sorted_b[j])
    taken = np.zeros(len(b_ns), bool)
    for k in np.lexsort((a_ns[i], gap)):
        if partner[i[k]] < 0 and not taken[j[k]]:
            partner[i[k]], taken[j[k]] = order_b[j[k]], True
    return partner


def match_moments(
    anchor_ns: Int[np.ndarray, " L"],
    others_ns: Mapping[str, Int[np.ndarray, " M"]],
    gate_ns: int | Int[np.ndarray, " L"],
    tied: Collection[str] | None = None,
) -> Matched:
    """Synchronised moments: each anchor with the nearest capture of each sensor, any two of them within the gate.

    Stamps may have any order and repeat: of equal stamps the first one counts. An incomplete moment is kept if no
    complete one within a second shows the same scene: there a sensor failed, or the rig lacks it.

    Args:
        gate_ns: one gate for the stamps as they are (paper, section 4.5.1: under 5 ms); or per anchor, the largest
            gap between two captures of its moment, constant gaps removed: calibration estimates them. Nearest then
            means within half a period, so that an anchor without a partner does not take a neighbour's.
        tied: for a rig with several sensors of a kind, those that can be calibrated against the anchor. A
            moment then needs one of them, each within the gate of the anchor, and may lack others: every edge
            uses the moments that have its own two sensors.
    """
    anchor = first_occurrences(anchor_ns)
    own, names, is_fixed = anchor_ns[anchor], list(others_ns), isinstance(gate_ns, int)
    gates = np.full(len(own), gate_ns, np.int64) if isinstance(gate_ns, int) else gate_ns[anchor]
    places = {}
    gap, has = np.zeros((len(names), len(own)), np.int64), np.zeros((len(names), len(own)), bool)
    for k, s in enumerate(names):
        once = first_occurrences(others_ns[s])
        stamps, reach_ns, constant_ns = others_ns[s][once], int(np.max(gate_ns, initial=0)), 0
        if not is_fixed:
            constant_ns = constant_gap_ns(own, stamps)
            period = _period_ns(stamps)
            reach_ns = reach_ns if period is None else int(_HALF_A_PERIOD * period)
        partner = match_nearest(own + constant_ns, stamps, reach_ns)
        near = partner >= 0
        gap[k, near] = stamps[partner[near]] - own[near] - constant_ns
        has[k] = near & (np.abs(gap[k]) <= gates)
        places[s] = np.append(once, -1)[partner]
    if tied is None:
        together, apart = _together(gap, has, gates)
        kept = _worth_having(own, 1 + together.sum(0), min(2, 1 + len(names)))
    else:
        together, apart = has, {}
        kept = np.logical_or.reduce(has[[name in tied for name in names]], axis=0)
    rejected = Counter[str]({Rejection.DUPLICATE_STAMP: len(anchor_ns) - len(anchor)})
    heard = [k for k, s in enumerate(names) if len(others_ns[s])] or list(range(len(names)))
    for i in np.flatnonzero(~kept):
        lacking = next((names[k] for k in heard if not has[k, i]), "")
        first, second = sorted(apart.get(int(i), (0, 0)))
        rejected[none_near(lacking) if lacking else f"{names[first]}_{names[second]}_outside_gate"] += 1
    others = {s: np.where(together[k, kept], places[s][kept], -1) for k, s in enumerate(names)}
    return Matched(anchor[kept], others, +rejected)


def constant_gap_ns(lidar_ns: Int[np.ndarray, " L"], stamps_ns: Int[np.ndarray, " M"]) -> int:
    """Constant gap of a triggered sensor's stamps after the sweeps' stamps [ns]; 0 if free-running.

    It is ambiguous by whole periods of the sensor; the value nearest to 0 is returned.
    """
    period = _period_ns(stamps_ns)
    if period is None or not len(lidar_ns):
        return 0
    gap = nearest_gaps_ns(lidar_ns, stamps_ns)
    gap = gap[np.abs(gap) <= _HALF_A_PERIOD * period]
    if not len(gap):
        return 0
    mean = np.mean(np.exp(2j * np.pi * gap / period))
    if abs(mean) < _TRIGGERED:
        return 0
    middle = float(np.angle(mean)) / (2 * np.pi) * period
    # Gaps near half a period may have either sign: shift them to one side of the mean before taking the
    # median.
    return round(middle + float(np.median((gap - middle + period / 2) % period - period / 2)))


def nearest_gaps_ns(a_ns: Int[np.ndarray, " N"], b_ns: Int[np.ndarray, " M"]) -> Int64[np.ndarray, " N"]:
    """Time from each stamp of a to the nearest of b [ns]; b is sorted, and not empty."""
    right = np.clip(np.searchsorted(b_ns, a_ns), 1, max(len(b_ns) - 1, 1))
    before, after = b_ns[right - 1] - a_ns, b_ns[np.minimum(right, len(b_ns) - 1)] - a_ns
    return np.where(np.abs(before) <= np.abs(after), before, after)


def _period_ns(stamps_ns: Int[np.ndarray, " M"]) -> float | None:
    """Median time between stamps; None for fewer than two."""
    return float(np.median(np.diff(np.sort(stamps_ns)))) if len(stamps_ns) > 1 else None


def _together(
    gap: Int64[np.ndarray, "S N"], has: Bool[np.ndarray, "S N"], gates: Int64[np.ndarray, " N"]
) -> tuple[Bool[np.ndarray, "S N"], dict[int, tuple[int, int]]]:
    """Captures within the gate by moment, and pairs outside; the farthest from the anchor are left out first."""
    kept, apart = has.copy(), {}
    low, high = np.where(kept, gap, 0).min(0, initial=0), np.where(kept, gap, 0).max(0, initial=0)
    for i in np.flatnonzero(high - low > gates):
        apart[int(i)] = (int(np.argmin(gap[:, i])), int(np.argmax(gap[:, i])))
        while np.ptp(np.append(gap[kept[:, i], i], 0)) > gates[i]:
            there = np.flatnonzero(kept[:, i])
            kept[there[np.argmax(np.abs(gap[there, i]))], i] = False
    return kept, apart


def _worth_having(
    stamps_ns: Int64[np.ndarray, " N"], sensors: Int[np.ndarray, " N"], least: int
) -> Bool[np.ndarray, " N"]:
    """Mask of moments, in order, with at least `least` sensors and no near moment that has more."""
    first = np.searchsorted(stamps_ns, stamps_ns - SAME_SCENE_NS, "left")
    end = np.searchsorted(stamps_ns, stamps_ns + SAME_SCENE_NS, "right")
    most = np.array([sensors[a:b].max() for a, b in zip(first, end, strict=True)], np.int64)
    return (sensors >= least) & (most == sensors)


def number_drives(stamps_ns: Int64[np.ndarray, " N"], logs: Sequence[int]) -> Int64[np.ndarray, " N"]:
    """Number of each sweep's stretch of driving, from 0: new where the log changes or stamps gap by 10 s."""
    order = np.argsort(stamps_ns, kind="stable")
    is_late = np.diff(stamps_ns[order]) > _DRIVE_GAP_NS
    is_other = np.diff(np.asarray(logs, np.int64)[order]) != 0
    drives = np.zeros(len(order), np.int64)
    drives[order[1:]] = np.cumsum(is_late | is_other)
    return drives
