"""Which image, sweep and scan belong together: stamps in, indices out; nothing is decoded for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from schemas.frames import SAME_SCENE_NS

__all__ = [
    "WRONG_UNIT",
    "Rejection",
    "Trios",
    "constant_gap_ns",
    "first_occurrences",
    "match_by_motion",
    "match_nearest",
    "match_trios",
    "motion_gates_ns",
    "number_drives",
]

_DRIVE_GAP_NS = 10 * 10**9
_HALF_A_PERIOD = 0.55  # and a tenth for jitter
# Length of the gaps' mean on the circle of a period: they scatter by a tenth of it, one sigma.
_TRIGGERED = 0.8
# What is taken for a car that nobody measured, and for others that drive past one that stands.
_UNKNOWN_MPS, _UNKNOWN_RADPS, _OTHERS_MPS = 40.0, float(np.radians(30.0)), 10.0


class Rejection(StrEnum):
    """Why a lidar sweep became no frame; each sweep is kept or counted under exactly one of these.

    Of a moment that is kept without a sensor, why it lacks that is counted as `without_SENSOR_REASON`.
    """

    DUPLICATE_STAMP = "duplicate_stamp"
    NO_CAMERA = "no_camera_in_gate"
    NO_LIDAR = "no_lidar_all_day"
    NO_RADAR = "no_radar_in_gate"
    SPREAD = "camera_radar_outside_gate"
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
class Trios:
    """Indices into the three stamp lists, in order of the lidar's stamp, and why sweeps found no partner.

    -1 where a moment has no image or no scan. `len(lidar) + sum(rejected.values())` is the number of sweeps.
    """

    lidar: Int64[np.ndarray, " N"]
    camera: Int64[np.ndarray, " N"]
    radar: Int64[np.ndarray, " N"]
    rejected: Counter[str] = field(default_factory=Counter)
    camera_gap_ns: int = 0  # the constant part of the stamps' gaps to the sweep's, found before gating
    radar_gap_ns: int = 0


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


def match_trios(
    lidar_ns: Int[np.ndarray, " L"],
    camera_ns: Int[np.ndarray, " C"],
    radar_ns: Int[np.ndarray, " R"],
    gate_ns: int,
) -> Trios:
    """Synchronised trios: every two stamps of one lie within the gate (paper, section 4.5.1: under 5 ms).

    A sweep with an image or a scan alone is taken where no whole trio within a second shows the same scene.

    Stamps may come in any order and more than once: the first of equal stamps counts.
    """
    lidar, camera, radar = (first_occurrences(s) for s in (lidar_ns, camera_ns, radar_ns))
    to_camera = match_nearest(lidar_ns[lidar], camera_ns[camera], gate_ns)
    to_radar = match_nearest(lidar_ns[lidar], radar_ns[radar], gate_ns)
    gates = np.full(len(lidar_ns), gate_ns, np.int64)
    stamps = lidar_ns, camera_ns, radar_ns
    return _gated(stamps, (lidar, camera, radar), (to_camera, to_radar), (0, 0), gates)


def match_by_motion(
    lidar_ns: Int[np.ndarray, " L"],
    camera_ns: Int[np.ndarray, " C"],
    radar_ns: Int[np.ndarray, " R"],
    gates_ns: Int[np.ndarray, " L"],
) -> Trios:
    """Each sweep with the image and the scan nearest to it, where the stamps' gaps are within the sweep's own gate.

    The constant part of a sensor's gaps is found first and counts for nothing: a calibration estimates it. Nearest
    means within half a period, so that a sweep without a partner does not borrow a neighbour's.

    Args:
        lidar_ns: stamps, in any order, the first of equal ones counts.
        camera_ns: likewise.
        radar_ns: likewise.
        gates_ns: per sweep, the largest gap beyond the constant ones between any two of its trio.
    """
    lidar, camera, radar = (first_occurrences(s) for s in (lidar_ns, camera_ns, radar_ns))
    partners, constant = [], []
    for stamps in (camera_ns[camera], radar_ns[radar]):
        constant.append(constant_gap_ns(lidar_ns[lidar], stamps))
        period = _period_ns(stamps)
        half = int(gates_ns.max(initial=0)) if period is None else int(_HALF_A_PERIOD * period)
        partners.append(match_nearest(lidar_ns[lidar] + constant[-1], stamps, half))
    stamps_ns = lidar_ns, camera_ns, radar_ns
    return _gated(
        stamps_ns,
        (lidar, camera, radar),
        (partners[0], partners[1]),
        (constant[0], constant[1]),
        gates_ns,
    )


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


def motion_gates_ns(
    speed_mps: Float[np.ndarray, " L"],
    yaw_rate_radps: Float[np.ndarray, " L"],
    move_m: float,
    turn_rad: float,
) -> Int64[np.ndarray, " L"]:
    """Per sweep, the time in which the car drives `move_m` or turns `turn_rad`, whichever comes first [ns].

    Speeds and yaw rates that are unknown (NaN) are taken for as high as a car's are.
    """
    speed = np.maximum(np.where(np.isnan(speed_mps), _UNKNOWN_MPS, np.abs(speed_mps)), _OTHERS_MPS)
    turn = np.where(np.isnan(yaw_rate_radps), _UNKNOWN_RADPS, np.abs(yaw_rate_radps))
    return (1e9 * np.minimum(move_m / speed, turn_rad / np.maximum(turn, 1e-6))).astype(np.int64)


def _period_ns(stamps_ns: Int[np.ndarray, " M"]) -> float | None:
    """Median time between stamps, None of fewer than two."""
    return float(np.median(np.diff(np.sort(stamps_ns)))) if len(stamps_ns) > 1 else None


def _gated(
    stamps_ns: tuple[np.ndarray, np.ndarray, np.ndarray],
    once: tuple[np.ndarray, np.ndarray, np.ndarray],
    partners: tuple[np.ndarray, np.ndarray],
    constant_ns: tuple[int, int],
    gates_ns: np.ndarray,
) -> Trios:
    """The trios of which every two stamps, less the constant gaps, lie within the sweep's gate; the others counted.

    Sweeps with one partner are taken far from whole trios only: there a sensor is silent or the rig has none.

    `once` are the places of the stamps that count, of lidar, camera and radar; `partners` are places in those of camera
    and radar, -1 = none.
    """
    lidar, own = once[0], stamps_ns[0][once[0]]
    gates, gaps = gates_ns[lidar], []
    for sensor in (0, 1):
        to, others = partners[sensor], stamps_ns[sensor + 1][once[sensor + 1]]
        gap = np.zeros(len(lidar), np.int64)
        gap[to >= 0] = others[to[to >= 0]] - own[to >= 0] - constant_ns[sensor]
        gaps.append(gap)
    has_camera = (partners[0] >= 0) & (np.abs(gaps[0]) <= gates)
    has_radar = (partners[1] >= 0) & (np.abs(gaps[1]) <= gates)
    both = has_camera & has_radar
    whole = both & (np.abs(gaps[0] - gaps[1]) <= gates)
    kept = whole | ((has_camera ^ has_radar) & _far_from(own, own[whole]))
    lacks_camera = ~kept & ~has_camera & (len(stamps_ns[1]) > 0 or len(stamps_ns[2]) == 0)
    rejected = Counter[str](
        {
            Rejection.DUPLICATE_STAMP: len(stamps_ns[0]) - len(lidar),
            Rejection.NO_CAMERA: int(np.sum(lacks_camera)),
            Rejection.NO_RADAR: int(np.sum(~kept & ~has_radar & ~lacks_camera)),
            Rejection.SPREAD: int(np.sum(both & ~kept)),
        }
    )
    camera, radar = (
        np.where(has[kept], _at(once[i + 1], partners[i][kept]), -1)
        for i, has in enumerate((has_camera, has_radar))
    )
    return Trios(lidar[kept], camera, radar, +rejected, *constant_ns)


def _at(places: np.ndarray, index: np.ndarray) -> np.ndarray:
    """`places[index]`, -1 where the index is."""
    return np.append(places, -1)[index]


def _far_from(
    stamps_ns: Int64[np.ndarray, " N"], others_ns: Int64[np.ndarray, " M"]
) -> Bool[np.ndarray, " N"]:
    """True where none of `others_ns`, in order, is so near in time that it shows the same scene."""
    first = np.searchsorted(others_ns, stamps_ns - SAME_SCENE_NS, "left")
    return first == np.searchsorted(others_ns, stamps_ns + SAME_SCENE_NS, "right")


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
