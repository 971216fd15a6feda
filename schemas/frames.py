"""What one camera, one lidar and one radar measured at a moment: rows of `images`, `sweeps`, `scans`, joined."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from schemas.captures import ImageColumns, ScanColumns, SweepColumns
from schemas.columns import row
from schemas.moments import EgoColumns

__all__ = ["Frame", "Seen"]


@row()
class Seen:
    """What a moment is, as one camera, one lidar and one radar saw it; each may be absent.

    Args:
        frame_index: row of `moments`.
        log: file name of the log that the moment came from.
        drive: continuous stretch of driving: the block of the bootstrap.
        sensors: of camera, lidar and radar those that the moment has; of another one arrays and bytes are empty,
            camera_K is NaN and the stamp is the moment's.
        stamp_ns: the sweep's stamp; without one, the moment's.
        camera_stamp_ns: of the image.
        radar_stamp_ns: of the scan.
        priors: T_parent_child before the day, by pair; camera_radar only where the lidar does not tie the two.
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
    """What the three measured; `lidar_stamp_ns` is the sweep's, from which per-point times count."""

    lidar_stamp_ns: int
