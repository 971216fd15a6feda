"""Features of one camera, one lidar and one radar at a moment: rows of their feature tables, joined."""

from __future__ import annotations

from schemas.columns import row
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns
from schemas.frames import Seen

__all__ = [
    "EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "STEP_BELOW", "STEP_RIGHT", "WITHOUT_LABELS",
    "Observation",
]  # fmt: skip

# Direction class of a depth jump or mask boundary as seen in the image: the side of the boundary on which the
# FOREGROUND lies (the nearer surface, or the object's mask). Only jumps and boundaries of the same class
# match.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3
# Bits of `steps_png`: brightness steps between a pixel and the next one of its row, or of its column.
STEP_RIGHT, STEP_BELOW = 1, 2
# What records, poses and pages state of a camera without semantics.
WITHOUT_LABELS = "no labels: borders are brightness steps"


@row()
class Observation(ImageFeatureColumns, SweepFeatureColumns, ScanFeatureColumns, Seen):
    """Features of one camera, one lidar and one radar at a moment; each sensor may be absent.

    Args:
        ego_speed_mps: from odometry if logged, else from the Doppler fit of static detections.
        ego_yaw_rate_radps: from odometry, else None.
        label_offset_px: from the labels to the picture, right and down [label px], where calibrate measured one.
    """

    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
    label_offset_px: tuple[float, float] = (0.0, 0.0)

    @property
    def is_unlabelled(self) -> bool:
        """Whether it has an image of a camera without semantics: steps of brightness, no labels, no road users."""
        return self.steps_png is not None
