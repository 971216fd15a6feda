"""Data of one sensor at the moments of a vehicle-day: tables `images`, `sweeps`, `scans`."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float32

from schemas.columns import TableSchema, array, column, per_point, row
from schemas.image_motion import EarlierColumns

__all__ = [
    "CAPTURES", "IMAGES", "SCANS", "SWEEPS", "CameraColumns", "Capture", "Image", "ImageColumns", "Scan",
    "ScanColumns", "Sweep", "SweepColumns",
]  # fmt: skip


@row()
class Capture:
    """First columns of every sensor's file."""

    moment: int = column("row of the table moments", kind="int32")
    stamp_ns: int = column("stamp of the sensor; per-point times of a sweep are relative to it")


@row()
class CameraColumns:
    """Intrinsics of a camera at one image."""

    image_width_px: int = column("image width for these intrinsics", kind="int32")
    image_height_px: int = column("image height for these intrinsics", kind="int32")
    camera_model: str = column(
        "'plumb_bob', 'rational_polynomial' or 'equidistant' (Kannala-Brandt; D = 0 is f-theta)"
    )
    camera_K: np.ndarray = array("<f8", (3, 3), "camera matrix [px]")
    camera_D: np.ndarray = array("<f8", ("N",), "distortion coefficients in ROS order")


@row()
class ImageColumns(CameraColumns):
    """An image, with logged labels and detections."""

    image: bytes = column("JPEG or PNG bytes exactly as logged (raw Image topics are encoded as PNG)")
    image_format: str = column("'jpeg' or 'png'")
    labels_png: bytes | None = column(
        "logged semantic label image, PNG mono8, labels of the config's label_set"
    )
    detection_boxes_px: np.ndarray | None = array(
        "<f4", ("N", 4), "logged road users: x0 y0 x1 y1 in full-image pixels"
    )
    detection_classes: list[str] | None = column("classes of the road users, as logged")
    detection_scores: np.ndarray | None = per_point("scores of the road users, 0..1")


@row()
class SweepColumns:
    """Points of a sweep."""

    lidar_x_m: np.ndarray = per_point("points in the lidar frame, de-skewed to stamp_ns where lidar_deskewed")
    lidar_y_m: np.ndarray = per_point("see lidar_x_m")
    lidar_z_m: np.ndarray = per_point("see lidar_x_m")
    lidar_intensity: np.ndarray | None = per_point("reflectivity as logged")
    lidar_ring: np.ndarray | None = per_point("beam number", "<u2")
    lidar_time_s: np.ndarray | None = per_point("time of each point relative to stamp_ns")
    lidar_deskewed: bool = column("points were transformed to stamp_ns by ego motion")

    @property
    def lidar_xyz_m(self) -> Float32[np.ndarray, "N 3"]:
        """Lidar points [m], lidar frame."""
        return np.stack([self.lidar_x_m, self.lidar_y_m, self.lidar_z_m], axis=-1)


@row()
class ScanColumns:
    """Detections of a radar scan."""

    radar_x_m: np.ndarray = per_point("detections in the radar frame")
    radar_y_m: np.ndarray = per_point("see radar_x_m")
    radar_z_m: np.ndarray = per_point("see radar_x_m; 0 if the radar measures no elevation")
    radar_range_rate_mps: np.ndarray = array(
        "<f4",
        ("N",),
        "Doppler as range rate: positive = receding, whatever the log's sign; not ego-compensated",
    )
    radar_power_db: np.ndarray | None = per_point("power or RCS as logged")
    radar_has_elevation: bool = column("False where all elevations are 0")
    doppler_period_mps: float | None = column("period of ambiguous range rates; null = unambiguous")

    @property
    def radar_xyz_m(self) -> Float32[np.ndarray, "M 3"]:
        """Radar detections [m], radar frame."""
        return np.stack([self.radar_x_m, self.radar_y_m, self.radar_z_m], axis=-1)


@row()
class Image(ImageColumns, EarlierColumns, Capture):
    """One row of `images`."""


@row()
class Sweep(SweepColumns, Capture):
    """One row of `sweeps`."""


@row()
class Scan(ScanColumns, Capture):
    """One row of `scans`."""


_ONE = "of one {}, in order of stamp; a file per {}. Table moments joins the rows of a moment."
IMAGES = TableSchema(
    Image, "images", 2, "Images " + _ONE.format("camera", "camera"), made_by="ingest", of_sensor=True
)
SWEEPS = TableSchema(
    Sweep, "sweeps", 1, "Sweeps " + _ONE.format("lidar", "lidar") + " x forward, y left, z up.",
    made_by="ingest", of_sensor=True,
)  # fmt: skip
SCANS = TableSchema(
    Scan, "scans", 1, "Scans " + _ONE.format("radar", "radar") + " x forward, y left, z up.",
    made_by="ingest", of_sensor=True,
)  # fmt: skip
CAPTURES: Final = {"camera": IMAGES, "lidar": SWEEPS, "radar": SCANS}
