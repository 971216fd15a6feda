"""Columns of a camera's own motion: the earlier image that ingest keeps, and what perception finds from both."""

from __future__ import annotations

import numpy as np

from schemas.columns import array, column, row

__all__ = ["EarlierColumns", "MotionColumns", "tracking_scale"]

_SMALL_PX = 1000


def tracking_scale(width_px: int) -> float:
    """Size at which corners are tracked: half, of images up to 1000 px wide full size."""
    return 1.0 if width_px <= _SMALL_PX else 0.5


@row()
class EarlierColumns:
    """An earlier image of the same camera, 1 to 6 m of driving before, and the car's motion in between by odometry."""

    earlier_stamp_ns: int | None = column("stamp of that image; null if there is none", default=None)
    earlier_image: bytes | None = column(
        "JPEG mono8 at half size, up to 1000 px wide at full size; null if it is the image of an earlier row",
        default=None,
    )
    earlier_missing: str | None = column("reason why there is no earlier image", default=None)
    ego_driven_m: float | None = column(
        "distance driven from the earlier image to this one, negative backwards; null without odometry",
        default=None,
    )
    ego_turned_rad: float | None = column(
        "yaw from the earlier image to this one, positive to the left; null without odometry", default=None
    )
    ego_turned_by_clock_radps: float | None = column(
        "change of ego_turned_rad if both images were a second later; null without odometry", default=None
    )


@row()
class MotionColumns:
    """Motion of a camera from its earlier image to this one; null where the images show none.

    Its axes lie midway between the camera's orientations at the two images. The rotation vector has the same
    coordinates in all three: R_earlier_now = exp(motion_turn_rad).
    """

    motion_span_s: float | None = column("stamp of this image minus that of the earlier one", default=None)
    motion_turn_rad: np.ndarray | None = array(
        "<f8", (3,), "rotation vector of R_earlier_now, camera axes", default=None
    )
    motion_direction: np.ndarray | None = array(
        "<f8", (3,), "unit vector of the camera's translation, camera axes midway", default=None
    )
    motion_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "covariance of motion_turn_rad and motion_direction from the scatter of the tracks; rank 5, because the "
        "direction has unit length",
        default=None,
    )
    motion_tracks: int | None = column("corners seen in both images", kind="int32", default=None)
    motion_tracks_px: np.ndarray | None = array(
        "<f4",
        ("N", 4),
        "tracks that follow the motion: u v in the earlier image, u v in this one, full-image pixels",
        default=None,
    )
    motion_spread: float | None = column(
        "share of 8 x 6 cells of the image that have such a track", default=None
    )
    motion_parallax_px: float | None = column(
        "median shift of these tracks that rotation does not explain, at the size of tracking", default=None
    )
    ego_driven_m: float | None = column("as in images", default=None)
    ego_turned_rad: float | None = column("as in images", default=None)
    ego_turned_by_clock_radps: float | None = column("as in images", default=None)
