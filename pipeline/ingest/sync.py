"""Which captures of a rig's sensors belong together: stamps in, indices out; nothing is decoded for it."""

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
_HALF_A_PERIOD = 0.55  # and a tenth for jitter
# Length of the gaps' mean on the circle of a period: they scatter by a tenth of it, one sigma.
_TRIGGERED = 0.8


class Rejection(StrEnum):
    """Why a sweep became no moment; each is kept, or counted under one of these or by the sensors that are apart.

    Of a moment that is kept without a sensor, why it lacks that is counted as `without_SENSOR_REASON`.
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
    """Indices into the stamp lists, in order of the anchor's stamp, and why anchors found no partner.

    `len(anchor) + sum(rejected.values())` is the number of anchors.

    Args:
        anchor: of the sweeps that moments are built about.
        others: by sensor, -1 where a moment has nothing of it.
        rejected: anchors that became no moment.
        constant_ns: by sensor, the constant part of its stamps' gaps to the anchor's, found before gating.
    """

    anchor: Int64[np.ndarray, " N"]
    others: Mapping[str, Int64[np.ndarray, " N"]]
    rejected: Counter[str] = field(default_factory=Counter)
    constant_ns: Mapping[str, int] = field(default_factory=dict)


def none_near(sensor: str) -> str:
    """The count of anchors that nothing of a sensor is near enough to."""
    return f"no_{sensor}_in_gate"


def first_occurrences(stamps_ns: Int[np.ndarray, " N"]) -> Int64[np.ndarray, " M"]:
    """Indices of stamps in order of time, each value once (the first one logged)."""
    return np.unique(stamps_ns, return_index=True)[1].astype(np.int64)


def match_nearest(
    a_ns: Int[np.ndarray, " N"], b_ns: Int[np.ndarray, " M"], gate_ns: int
) -> Int64[np.ndarray, " N"]:
    """For each stamp of a the index of its partner in b within the gate, else -1; each b is used once.

    Of two that want the same b the nearer one gets it (the earlier, where they are as near); the other gets
    its next nearest that is free.
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
    """Synchronised moments: every two stamps of one lie within the gate (paper, section 4.5.1: under 5 ms).

    One that lacks sensors is taken where no whole one within a second shows the same scene. For rigs of many sensors
    (`tied`) the gate is between each stamp and the anchor's.

    Stamps may come in any order and more than once: the first of equal stamps counts.
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
    """Each anchor with what of each sensor is nearest to it, where the stamps' gaps are within the anchor's own gate.

    The constant part of a sensor's gaps is found first and counts for nothing: a calibration estimates it. Nearest
    means within half a period, so that an anchor without a partner does not borrow a neighbour's.

    Args:
        anchor_ns: stamps of the sensor that moments are built about, in any order, the first of equal ones counts.
        others_ns: of the others by name, likewise.
        gates_ns: per anchor, the largest gap beyond the constant ones between any two captures of its moment.
        tied: of a rig with several sensors of a kind, those that can be calibrated against the anchor. A moment is what
            one of them belongs to, each sensor within the gate of the anchor, whatever others it lacks: every edge
            takes the moments that its own two sensors have.
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
    """By how much the stamps of a triggered sensor come after the sweeps' [ns]; 0 where it runs freely.

    It is known up to whole periods of the sensor, and the one next to 0 is taken.

    Args:
        lidar_ns: stamps of the sweeps.
        stamps_ns: of the sensor, each once, in order.
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
    # Gaps of half a period are of either sign: all on the side of the mean, before their median is taken.
    return round(middle + float(np.median((gap - middle + period / 2) % period - period / 2)))


def _period_ns(stamps_ns: Int[np.ndarray, " M"]) -> float | None:
    """Median time between stamps, None of fewer than two."""
    return float(np.median(np.diff(np.sort(stamps_ns)))) if len(stamps_ns) > 1 else None


def _gated(
    anchor_ns: np.ndarray,
    others_ns: Mapping[str, np.ndarray],
    partners: Mapping[str, np.ndarray],
    constant_ns: Mapping[str, int],
    gates: np.ndarray,
    tied: Collection[str] | None,
) -> Matched:
    """The moments of which every two stamps, less the constant gaps, lie within the anchor's gate; the others counted.

    Anchors without all partners are taken far from whole moments only: there a sensor is silent or the rig has none.
    Where sensors are `tied` to the anchor, gates and what a moment may lack are as `match_by_motion` says.

    `partners` are places in the stamps that count of each sensor, -1 = none.
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
    """What of each moment lies within its gate, the farthest from the anchor left out while two are farther apart.

    Also the two that were, by moment.
    """
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
    """Moments, in order, of so many sensors or more that none with more near in time shows too."""
    first = np.searchsorted(stamps_ns, stamps_ns - SAME_SCENE_NS, "left")
    end = np.searchsorted(stamps_ns, stamps_ns + SAME_SCENE_NS, "right")
    most = np.array([sensors[a:b].max() for a, b in zip(first, end, strict=True)], np.int64)
    return (sensors >= least) & (most == sensors)


def _at(places: np.ndarray, index: np.ndarray) -> np.ndarray:
    """`places[index]`, -1 where the index is."""
    return np.append(places, -1)[index]


def number_drives(stamps_ns: Sequence[int], logs: Sequence[int]) -> Int64[np.ndarray, " N"]:
    """Number of the continuous stretch of driving that each sweep (in order of time) belongs to, from 0.

    It grows where the log changes or where the stamps gap by more than 10 s.
    """
    if not len(stamps_ns):
        return np.zeros(0, np.int64)
    new = (np.diff(np.asarray(stamps_ns, np.int64)) > _DRIVE_GAP_NS) | (
        np.diff(np.asarray(logs, np.int64)) != 0
    )
    return np.concatenate([[0], np.cumsum(new)]).astype(np.int64)
