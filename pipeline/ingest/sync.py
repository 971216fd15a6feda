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
    "WRONG_UNIT",
    "Matched",
    "Rejection",
    "constant_gap_ns",
    "first_occurrences",
    "match_by_motion",
    "match_by_stamp",
    "match_nearest",
    "none_near",
    "number_drives",
]

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
        constant_ns: by sensor, the constant gap of its stamps to the anchor's, found before gating.
    """

    anchor: Int64[np.ndarray, " N"]
    others: Mapping[str, Int64[np.ndarray, " N"]]
    rejected: Counter[str] = field(default_factory=Counter)
    constant_ns: Mapping[str, int] = field(default_factory=dict)


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
    i = np.repeat(np.arange(len(a_ns)), high - low)
    j = (
        np.arange(len(i))
        - np.repeat(np.cumsum(high - low) - (high - low), high - low)
        + np.repeat(low, high - low)
    )
    gap = np.abs(a_ns[i].astype(np.int64) - sorted_b[j])
    taken = np.zeros(len(b_ns), bool)
    for k in np.lexsort((a_ns[i], gap)):
        if partner[i[k]] < 0 and not taken[j[k]]:
            partner[i[k]], taken[j[k]] = order_b[j[k]], True
    return partner


def match_by_stamp(
    anchor_ns: Int[np.ndarray, " L"],
    others_ns: Mapping[str, Int[np.ndarray, " M"]],
    gate_ns: int,
    tied: Collection[str] | None = None,
) -> Matched:
    """Synchronised moments: any two stamps of one are within the gate (paper, section 4.5.1: under 5 ms).

    An incomplete moment is kept if no complete one within a second shows the same scene. For rigs of many
    sensors (`tied`) the gate applies between each stamp and the anchor's.

    Stamps may have any order and repeat: of equal stamps the first one counts.
    """
    anchor = first_occurrences(anchor_ns)
    once = {s: stamps[first_occurrences(stamps)] for s, stamps in others_ns.items()}
    partners = {s: match_nearest(anchor_ns[anchor], stamps, gate_ns) for s, stamps in once.items()}
    gates = np.full(len(anchor), gate_ns, np.int64)
    return _gated(anchor_ns, others_ns, partners, dict.fromkeys(once, 0), gates, tied)


def match_by_motion(
    anchor_ns: Int[np.ndarray, " L"],
    others_ns: Mapping[str, Int[np.ndarray, " M"]],
    gates_ns: Int[np.ndarray, " L"],
    tied: Collection[str] | None = None,
) -> Matched:
    """Each anchor with the nearest capture of each sensor, if the gap is within the anchor's own gate.

    The constant part of a sensor's gaps is removed first: calibration estimates it. Nearest means within half
    a period, so that an anchor without a partner does not take a neighbour's.

    Args:
        gates_ns: per anchor, the largest gap between two captures of its moment, constant gaps removed.
        tied: for a rig with several sensors of a kind, those that can be calibrated against the anchor. A
            moment then needs one of them, each within the gate of the anchor, and may lack others: every edge
            uses the moments that have its own two sensors.
    """
    anchor = first_occurrences(anchor_ns)
    partners, constant = {}, {}
    for sensor, stamps_ns in others_ns.items():
        stamps = stamps_ns[first_occurrences(stamps_ns)]
        constant[sensor] = constant_gap_ns(anchor_ns[anchor], stamps)
        period = _period_ns(stamps)
        half = int(gates_ns.max(initial=0)) if period is None else int(_HALF_A_PERIOD * period)
        partners[sensor] = match_nearest(anchor_ns[anchor] + constant[sensor], stamps, half)
    return _gated(anchor_ns, others_ns, partners, constant, gates_ns[anchor], tied)


def constant_gap_ns(lidar_ns: Int[np.ndarray, " L"], stamps_ns: Int[np.ndarray, " M"]) -> int:
    """Constant gap of a triggered sensor's stamps after the sweeps' stamps [ns]; 0 if free-running.

    It is ambiguous by whole periods of the sensor; the value nearest to 0 is returned.
    """
    period = _period_ns(stamps_ns)
    if period is None or not len(lidar_ns):
        return 0
    right = np.clip(np.searchsorted(stamps_ns, lidar_ns), 1, len(stamps_ns) - 1)
    before, after = stamps_ns[right - 1] - lidar_ns, stamps_ns[right] - lidar_ns
    gap = np.where(np.abs(before) <= np.abs(after), before, after)
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


def _period_ns(stamps_ns: Int[np.ndarray, " M"]) -> float | None:
    """Median time between stamps; None for fewer than two."""
    return float(np.median(np.diff(np.sort(stamps_ns)))) if len(stamps_ns) > 1 else None


def _gated(
    anchor_ns: np.ndarray,
    others_ns: Mapping[str, np.ndarray],
    partners: Mapping[str, np.ndarray],
    constant_ns: Mapping[str, int],
    gates: np.ndarray,
    tied: Collection[str] | None,
) -> Matched:
    """Moments with all stamps, constant gaps removed, within the anchor's gate; the others are counted.

    Incomplete anchors are kept only far from complete moments: there a sensor failed or the rig lacks it. For
    sensors `tied` to the anchor, gates and incomplete moments are as in `match_by_motion`.

    `partners` are indices into the distinct stamps of each sensor, -1 = none.
    """
    anchor = first_occurrences(anchor_ns)
    names, own = list(others_ns), anchor_ns[anchor]
    once = {s: first_occurrences(others_ns[s]) for s in names}
    gap, has = np.zeros((len(names), len(own)), np.int64), np.zeros((len(names), len(own)), bool)
    for k, s in enumerate(names):
        near, stamps = partners[s] >= 0, others_ns[s][once[s]]
        gap[k, near] = stamps[partners[s][near]] - own[near] - constant_ns[s]
        has[k] = near & (np.abs(gap[k]) <= gates)
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
        a, b = sorted(apart.get(int(i), (0, 0)))
        rejected[none_near(lacking) if lacking else f"{names[a]}_{names[b]}_outside_gate"] += 1
    others = {
        s: np.where(together[k, kept], _at(once[s], partners[s][kept]), -1) for k, s in enumerate(names)
    }
    return Matched(anchor[kept], others, +rejected, constant_ns)


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


def _at(places: np.ndarray, index: np.ndarray) -> np.ndarray:
    """`places[index]`, -1 where the index is -1."""
    return np.append(places, -1)[index]


def number_drives(stamps_ns: Sequence[int], logs: Sequence[int]) -> Int64[np.ndarray, " N"]:
    """Number of each sweep's stretch of driving, from 0: new where the log changes or stamps gap by 10 s."""
    if not len(stamps_ns):
        return np.zeros(0, np.int64)
    new = (np.diff(np.asarray(stamps_ns, np.int64)) > _DRIVE_GAP_NS) | (
        np.diff(np.asarray(logs, np.int64)) != 0
    )
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)
