"""A radar scan as a polar grid seen from above, and free sectors on it: input and output of a small network.

Rows are azimuths (right to left), columns ranges, in the radar frame (x forward, y left). Perception and
training both use these functions.

Source: paper, section 4.2 (a weakly supervised network segments the radar's drivable area); the grid is ours.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

__all__ = [
    "CHANNELS", "RANGE_STEP_M", "SHAPE", "Scan", "ScanMemory", "cell_centres", "grid_layout", "scan_features",
    "sector_mask", "sector_of",
]  # fmt: skip

CHANNELS = ("static", "moving", "undecided", "power", "residual", "recent_static", "static_until", "range")
SHAPE = (70, 60)  # azimuths, ranges: the extent of the geometric free sector
AZIMUTH_STEP_RAD, RANGE_STEP_M = float(np.deg2rad(2.0)), 1.0
_FIRST_RAD = -SHAPE[0] / 2 * AZIMUTH_STEP_RAD
_MIN_RANGE_M = 1.5  # bumper and radome echoes
_HEIGHT_M = 2.5  # signs and branches are above, multipath images below
_RECENT_SCANS, _RECENT_S = 3, 1.0
_STATIC, _MOVING, _UNDECIDED = 0, 1, 2
_POWER_DB, _RESIDUAL_MPS = 10.0, 5.0  # scale of the features: these values become 1


@dataclass(frozen=True, eq=False)
class Scan:
    """One radar scan after Doppler compensation.

    Args:
        drive: drive number; scans of different drives are not combined.
        xyz_m: detections, radar frame.
        power_db: power or RCS as logged; None = not logged.
        residual_mps: range rate minus that of a static point.
        motion: 0 static, 1 moving, 2 undecided.
        has_elevation: False if the radar measures no heights.
        velocity_mps: x and y velocity of the radar; None = unknown.
    """

    stamp_ns: int
    drive: int
    xyz_m: Float32[np.ndarray, "M 3"]
    power_db: Float32[np.ndarray, " M"] | None
    residual_mps: Float32[np.ndarray, " M"]
    motion: UInt8[np.ndarray, " M"]
    has_elevation: bool
    velocity_mps: tuple[float, float] | None
    yaw_rate_radps: float | None


class ScanMemory:
    """The last scans of a drive, transformed to the current radar pose."""

    def __init__(self) -> None:
        self._scans: deque[Scan] = deque(maxlen=_RECENT_SCANS)

    def features(self, scan: Scan) -> Float32[np.ndarray, "C A R"]:
        """Features of the scan given the previous ones; stores the scan. Scans must be in order of stamp."""
        recent = [
            s
            for s in self._scans
            if s.drive == scan.drive and 0 < scan.stamp_ns - s.stamp_ns <= _RECENT_S * 1e9
        ]
        out = scan_features(scan, recent)
        self._scans.append(scan)
        return out


def grid_layout() -> dict[str, Any]:
    """Grid parameters that a model must have been trained with."""
    return {
        "channels": list(CHANNELS),
        "directions": SHAPE[0],
        "ranges": SHAPE[1],
        "direction_step_deg": round(float(np.degrees(AZIMUTH_STEP_RAD)), 6),
        "range_step_m": RANGE_STEP_M,
    }


def cell_centres() -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, " R"]]:
    """Azimuths [rad] and ranges [m] of the cells' centres."""
    azimuth = _FIRST_RAD + (np.arange(SHAPE[0]) + 0.5) * AZIMUTH_STEP_RAD
    return azimuth, (np.arange(SHAPE[1]) + 0.5) * RANGE_STEP_M


def scan_features(scan: Scan, recent: list[Scan]) -> Float32[np.ndarray, "C A R"]:
    """The channels of CHANNELS, each about 0..1.

    Counts are logarithmic; power is relative to the scan's median, because units differ between radars;
    `static_until` counts static detections at or before a cell in its direction.
    """
    cell, inside = _cells(scan.xyz_m, scan.has_elevation)
    counts = [_count(cell[inside & (scan.motion == m)]) for m in (_STATIC, _MOVING, _UNDECIDED)]
    power = np.zeros(len(cell))
    if scan.power_db is not None and np.isfinite(scan.power_db).any():
        power = np.nan_to_num(scan.power_db - np.nanmedian(scan.power_db)) / _POWER_DB
    residual = np.abs(np.nan_to_num(scan.residual_mps)) / _RESIDUAL_MPS
    before = np.zeros(SHAPE)
    for old in recent:
        xyz = _carried(old, scan)
        if xyz is not None:
            was, valid = _cells(xyz, old.has_elevation)
            before += _count(was[valid & (old.motion == _STATIC)])
    ranges = np.broadcast_to(cell_centres()[1] / (SHAPE[1] * RANGE_STEP_M), SHAPE)
    channels = [
        *(np.log1p(c) for c in counts),
        _mean(cell[inside], power[inside]),
        _mean(cell[inside], residual[inside]),
        np.log1p(before),
        np.log1p(np.cumsum(counts[0], axis=1)) / 2,
        ranges,
    ]
    return np.clip(np.stack(channels), -3, 3).astype(np.float32)


def sector_of(
    probability: Float[np.ndarray, "A R"],
) -> tuple[Float32[np.ndarray, " B"], Float32[np.ndarray, " B"]]:
    """Azimuths and free ranges that fit the drivable probability of the cells best.

    The free range of a direction classifies most of its cells correctly, weighted by confidence. Directions
    without free cells are left out at both ends of the sector; between other directions their range is 0 m.
    """
    gain = np.cumsum(probability - 0.5, axis=1)
    cut = np.argmax(np.pad(gain, ((0, 0), (1, 0))), axis=1)
    free = np.flatnonzero(cut)
    if not free.size:
        return np.zeros(0, np.float32), np.zeros(0, np.float32)
    rows = slice(free[0], free[-1] + 1)
    return cell_centres()[0][rows].astype(np.float32), (cut[rows] * RANGE_STEP_M).astype(np.float32)


def sector_mask(
    azimuth_rad: Float[np.ndarray, " B"], range_m: Float[np.ndarray, " B"]
) -> Bool[np.ndarray, "A R"]:
    """Cells with centres in a free sector, as in the objective's map."""
    azimuth, ranges = cell_centres()
    if not len(azimuth_rad):
        return np.zeros(SHAPE, bool)
    half = AZIMUTH_STEP_RAD / 2
    known = (azimuth > azimuth_rad.min() - half) & (azimuth < azimuth_rad.max() + half)
    free = np.interp(azimuth, azimuth_rad, range_m)
    return known[:, None] & (ranges < free[:, None])


def _cells(xyz_m: np.ndarray, has_elevation: bool) -> tuple[np.ndarray, np.ndarray]:
    """Flat cell index of each detection, and a mask of those inside the grid."""
    azimuth, range_m = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]), np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    finite = np.isfinite(azimuth) & np.isfinite(range_m)
    a = np.floor((np.where(finite, azimuth, 0) - _FIRST_RAD) / AZIMUTH_STEP_RAD).astype(int)
    r = np.floor(np.where(finite, range_m, 0) / RANGE_STEP_M).astype(int)
    inside = finite & (a >= 0) & (a < SHAPE[0]) & (r < SHAPE[1]) & (range_m > _MIN_RANGE_M)
    if has_elevation:
        inside &= np.abs(xyz_m[:, 2]) < _HEIGHT_M
    return np.where(inside, a * SHAPE[1] + r, 0), inside


def _count(cell: np.ndarray) -> np.ndarray:
    return np.bincount(cell, minlength=SHAPE[0] * SHAPE[1]).reshape(SHAPE).astype(np.float64)


def _mean(cell: np.ndarray, value: np.ndarray) -> np.ndarray:
    total = np.bincount(cell, value, minlength=SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    return total / np.maximum(_count(cell), 1)


def _carried(old: Scan, now: Scan) -> np.ndarray | None:
    """Static detections of an older scan in the current radar frame; None if the motion is unknown."""
    if old.velocity_mps is None or now.velocity_mps is None:
        return None
    seconds = (now.stamp_ns - old.stamp_ns) * 1e-9
    shift = (np.array(old.velocity_mps) + np.array(now.velocity_mps)) / 2 * seconds
    turn = (old.yaw_rate_radps or 0.0) * seconds
    # The chord of an arc is at half the turning angle.
    c, s = np.cos(turn / 2), np.sin(turn / 2)
    x, y = (old.xyz_m[:, :2] - np.array([c * shift[0] - s * shift[1], s * shift[0] + c * shift[1]])).T
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * x + s * y, -s * x + c * y, old.xyz_m[:, 2]], axis=-1)
