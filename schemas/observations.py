"""What one camera, one lidar and one radar show at a moment: rows of their features, joined."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from schemas.columns import row
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns

__all__ = ["EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "Observation"]

# Direction class of a depth jump or mask boundary, always as seen in the image: on which side of the boundary the
# FOREGROUND (the nearer surface, or the object's mask) lies. Jumps and boundaries match only in the same class.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3


@row()
class Observation(ImageFeatureColumns, SweepFeatureColumns, ScanFeatureColumns):
    """What a moment shows to one camera, one lidar and one radar; each may be absent.

    Args:
        frame_index: row of `moments`.
        log: file name of the log that the moment came from.
        drive: continuous stretch of driving: the block of the bootstrap.
        sensors: of camera, lidar and radar those that show something; what another one would show is empty.
        stamp_ns: the sweep's stamp; without one, the moment's.
        camera_stamp_ns: of the image.
        radar_stamp_ns: of the scan.
        priors: T_parent_child before the day, by pair; camera_radar only where the lidar does not tie the two.
        ego_speed_mps: from odometry where logged, else from the Doppler fit of the static world.
        ego_yaw_rate_radps: from odometry, else None.
    """

    frame_index: int
    log: str
    drive: int
    sensors: list[str]
    stamp_ns: int
    camera_stamp_ns: int
    radar_stamp_ns: int
    priors: Mapping[str, np.ndarray]
    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
