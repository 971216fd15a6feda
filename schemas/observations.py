"""Features of one camera, one lidar and one radar at a moment: rows of their feature tables, joined."""

from __future__ import annotations

from schemas.columns import row
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns
from schemas.frames import Seen

__all__ = ["EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "Observation"]

# Direction class of a depth jump or mask boundary as seen in the image: the side of the boundary on which the
# FOREGROUND lies (the nearer surface, or the object's mask). Only jumps and boundaries of the same class
# match.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3


@row()
class Observation(ImageFeatureColumns, SweepFeatureColumns, ScanFeatureColumns, Seen):
    """Features of one camera, one lidar and one radar at a moment; each sensor may be absent.

    Args:
        ego_speed_mps: from odometry if logged, else from the Doppler fit of static detections.
        ego_yaw_rate_radps: from odometry, else None.
    """

    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
