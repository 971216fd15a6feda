"""Why a frame is left out: one reason per frame, counted in the manifest of the partition."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["FrameReason", "FrameRejectedError"]


class FrameReason(StrEnum):
    """Reasons against a frame; the value is the key of the counts."""

    UNDECODABLE_IMAGE = "image_undecodable"
    IMAGE_SIZE = "image_size_differs_from_camera_info"
    CAMERA_MODEL = "camera_model_invalid"
    NO_LABELS = "labels_missing"
    UNDECODABLE_LABELS = "labels_undecodable"
    LABELS_SHAPE = "labels_aspect_differs_from_image"
    NO_DETECTIONS = "detections_missing"
    BAD_DETECTIONS = "detections_invalid"
    FEW_LIDAR_POINTS = "lidar_points_too_few"
    FEW_RADAR_POINTS = "radar_points_too_few"


class FrameRejectedError(Exception):
    """One frame cannot be used, for `reason`; handled within the stage."""

    def __init__(self, reason: FrameReason) -> None:
        self.reason = reason
        super().__init__(reason.value)
