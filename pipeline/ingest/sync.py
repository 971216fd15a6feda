"""Which image, sweep and scan belong together: stamps in, indices out; nothing is decoded for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Int, Int64

__all__ = ["Rejection", "Trios", "first_occurrences", "match_nearest", "match_trios", "number_drives"]

_DRIVE_GAP_NS = 10 * 10**9


class Rejection(StrEnum):
    """Why a lidar sweep became no frame; each sweep is kept or counted under exactly one of these."""

    DUPLICATE_STAMP = "duplicate_stamp"
    NO_CAMERA = "no_camera_in_gate"
    NO_RADAR = "no_radar_in_gate"
    SPREAD = "camera_radar_outside_gate"
    NOT_PICKED = "beyond_max_frames"
    IMAGE_DAMAGED = "image_damaged"
    IMAGE_SIZE = "image_size_differs_from_camera_info"
    CAMERA_INFO = "no_usable_camera_info"
    LIDAR_DAMAGED = "lidar_undecodable"
    LIDAR_SPARSE = "too_few_lidar_points"
    RADAR_DAMAGED = "radar_undecodable"
    RADAR_SPARSE = "too_few_radar_points"


@dataclass(frozen=True, eq=False)
class Trios:
    """Indices into the three stamp lists, in order of the lidar's stamp, and why sweeps found no partner.

    `len(lidar) + sum(rejected.values())` is the number of sweeps.
    """

    lidar: Int64[np.ndarray, " N"]
    camera: Int64[np.ndarray, " N"]
    radar: Int64[np.ndarray, " N"]
    rejected: Counter[str] = field(default_factory=Counter)


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

    Stamps may come in any order and more than once: the first of equal stamps counts.
    """
    lidar, camera, radar = (first_occurrences(s) for s in (lidar_ns, camera_ns, radar_ns))
    rejected = Counter[str]({Rejection.DUPLICATE_STAMP: len(lidar_ns) - len(lidar)})
    to_camera = match_nearest(lidar_ns[lidar], camera_ns[camera], gate_ns)
    to_radar = match_nearest(lidar_ns[lidar], radar_ns[radar], gate_ns)
    both = (to_camera >= 0) & (to_radar >= 0)
    spread = np.zeros(len(lidar), np.int64)
    if both.any():
        spread[both] = np.abs(camera_ns[camera[to_camera[both]]] - radar_ns[radar[to_radar[both]]])
    kept = both & (spread <= gate_ns)
    rejected[Rejection.NO_CAMERA] = int(np.sum(to_camera < 0))
    rejected[Rejection.NO_RADAR] = int(np.sum((to_camera >= 0) & (to_radar < 0)))
    rejected[Rejection.SPREAD] = int(np.sum(both & ~kept))
    return Trios(lidar[kept], camera[to_camera[kept]], radar[to_radar[kept]], +rejected)


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
