"""What one camera, one lidar and one radar show at a moment: rows of their features, joined."""

from __future__ import annotations

from schemas.columns import row
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns
from schemas.frames import Seen

__all__ = ["EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "Observation"]

# Direction class of a depth jump or mask boundary, always as seen in the image: on which side of the boundary the
# FOREGROUND (the nearer surface, or the object's mask) lies. Jumps and boundaries match only in the same class.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3


@row()
class Observation(ImageFeatureColumns, SweepFeatureColumns, ScanFeatureColumns, Seen):
    """What a moment shows to one camera, one lidar and one radar; each may be absent.

    Args:
        ego_speed_mps: from odometry where logged, else from the Doppler fit of the static world.
        ego_yaw_rate_radps: from odometry, else None.
    """

    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
