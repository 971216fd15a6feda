"""Free range of the road in each direction, seen by the radar.

The static returns of a road scene come from kerbs, rails, walls and parked cars; the asphalt reflects away
from the radar. The free sector of a direction ends at its nearest static return that has neighbours. This
geometry is the fallback for the paper's weakly supervised network (section 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8
from numba import njit

from pipeline.rig.radar_grid import Scan

__all__ = ["DrivableSource", "FreeSector", "free_sector"]

_BIN_RAD = np.deg2rad(2.0)
_HALF_SECTOR_RAD = np.deg2rad(70.0)
_MAX_RANGE_M = 60.0
_MIN_RANGE_M = 1.5  # bumper and radome echoes
_HEIGHT_M = 2.5  # above this over the radar hang signs and branches; below it lie multipath images
_NEIGHBOURS = 2
_NEIGHBOUR_M, _NEIGHBOUR_FRACTION = 1.0, 0.03
_MAX_GAP_BINS = 4
_STATIC = 0


@dataclass(frozen=True, eq=False)
class FreeSector:
    """Drivable until `range_m` at each `azimuth_rad` (bin centres, radar frame, increasing).

    Directions without evidence are absent.
    """

    azimuth_rad: Float32[np.ndarray, " B"]
    range_m: Float32[np.ndarray, " B"]


@runtime_checkable
class DrivableSource(Protocol):
    """Source of the radar's drivable area in place of geometry, scan by scan of a vehicle-day."""

    provenance: dict[str, Any]  # what of it belongs into the work key

    def free_sector(self, scan: Scan) -> FreeSector:
        """Free ranges by direction."""
        ...


def free_sector(
    xyz_m: Float32[np.ndarray, "M 3"], motion: UInt8[np.ndarray, " M"], has_elevation: bool
) -> FreeSector:
    """Range to the nearest supported static return per azimuth bin; moving road users do not end it."""
    range_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    could_end = (motion == _STATIC) & (range_m > _MIN_RANGE_M) & (range_m < _MAX_RANGE_M)
    could_end &= np.abs(np.arctan2(xyz_m[:, 1], xyz_m[:, 0])) < _HALF_SECTOR_RAD
    if has_elevation:
        could_end &= np.abs(xyz_m[:, 2]) < _HEIGHT_M
    points = _supported(xyz_m[could_end])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    bins = round(2 * _HALF_SECTOR_RAD / _BIN_RAD)
    nearest = np.full(bins, np.inf)
    np.minimum.at(
        nearest,
        np.floor((azimuth + _HALF_SECTOR_RAD) / _BIN_RAD).astype(int),
        np.hypot(points[:, 0], points[:, 1]),
    )
    centres = -_HALF_SECTOR_RAD + (np.arange(bins) + 0.5) * _BIN_RAD
    return _bridge_gaps(centres, nearest)


def _supported(points_m: np.ndarray) -> np.ndarray:
    """Points with enough neighbours: clutter and multipath are single points."""
    if not len(points_m):
        return points_m
    plane = points_m[:, :2].astype(np.float64)
    radius = _NEIGHBOUR_M + _NEIGHBOUR_FRACTION * np.linalg.norm(plane, axis=1)
    order = np.argsort(plane[:, 0], kind="stable")
    keep = np.empty(len(plane), bool)
    keep[order] = _have_others(plane[order], radius[order], _NEIGHBOURS)
    return points_m[keep]


@no_type_check  # keeps the tests' shape checks out of compiled code
@njit(cache=True)
def _have_others(xy: np.ndarray, radius: np.ndarray, wanted: int) -> np.ndarray:
    """True for points with more than so many points, including itself, within their radius; sorted by x."""
    enough = np.zeros(len(xy), np.bool_)
    for i in range(len(xy)):
        found = 1
        for way in (-1, 1):
            j = i + way
            while found <= wanted and 0 <= j < len(xy) and abs(xy[j, 0] - xy[i, 0]) <= radius[i]:
                dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
                if dx * dx + dy * dy <= radius[i] * radius[i]:
                    found += 1
                j += way
        enough[i] = found > wanted
    return enough


def _bridge_gaps(centres_rad: np.ndarray, nearest_m: np.ndarray) -> FreeSector:
    """Bins without a return are interpolated between their neighbours; wide gaps stay empty."""
    seen = np.flatnonzero(np.isfinite(nearest_m))
    if not seen.size:
        return FreeSector(np.zeros(0, np.float32), np.zeros(0, np.float32))
    rows = np.arange(seen[0], seen[-1] + 1)
    after = np.searchsorted(seen, rows)
    gap = seen[after] - seen[np.maximum(after - 1, 0)]
    known = np.isfinite(nearest_m[rows]) | (gap <= _MAX_GAP_BINS + 1)
    filled = np.interp(rows, seen, nearest_m[seen])
    # A look through a gap between two posts, one bin wide, is no way to drive.
    padded = np.pad(filled, 1, mode="edge")
    filled = np.minimum(filled, np.maximum(padded[:-2], padded[2:]))
    return FreeSector(centres_rad[rows][known].astype(np.float32), filled[known].astype(np.float32))
