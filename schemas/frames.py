"""Data of one camera, one lidar and one radar at a moment: rows of `images`, `sweeps`, `scans`, joined."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from schemas.captures import ImageColumns, ScanColumns, SweepColumns
from schemas.columns import row
from schemas.moments import EgoColumns

__all__ = ["Frame", "Seen"]


@row()
class Seen:
    """Moment of one camera, one lidar and one radar; each sensor may be absent.

    Args:
        frame_index: row of `moments`.
        drive: continuous stretch of driving: the block of the bootstrap.
        sensors: the sensors present, of camera, lidar and radar. For an absent one, arrays and bytes are
            empty, camera_K is NaN and the stamp is the moment's.
        stamp_ns: stamp of the sweep; without a sweep, of the moment.
        priors: T_parent_child before the day, by pair; camera_radar only if the lidar does not connect the
            two.
    """

    frame_index: int
    log: str
    drive: int
    sensors: list[str]
    stamp_ns: int
    camera_stamp_ns: int
    radar_stamp_ns: int
    priors: Mapping[str, np.ndarray]


@row()
class Frame(ImageColumns, SweepColumns, ScanColumns, EgoColumns, Seen):
    """Data of the three sensors; per-point times are relative to `lidar_stamp_ns`, the stamp of the sweep."""

    lidar_stamp_ns: int
