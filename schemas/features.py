"""Features found by perception, a file per sensor: `image_features`, `sweep_features`, `scan_features`.

Points stay in the frame of their sensor.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.captures import CameraColumns, Capture
from schemas.columns import TableSchema, array, column, per_point, points, row
from schemas.image_motion import MotionColumns

__all__ = [
    "FEATURES", "IMAGE_FEATURES", "SCAN_FEATURES", "SWEEP_FEATURES", "ImageFeatureColumns", "ImageFeatures",
    "ScanFeatureColumns", "ScanFeatures", "SweepFeatureColumns", "SweepFeatures",
]  # fmt: skip


@row()
class ImageFeatureColumns(MotionColumns, CameraColumns):
    """Features of an image, the intrinsics of its camera, and the camera's motion."""

    labels_png: bytes = column(
        "PNG mono8 of Cityscapes train ids (0 road .. 18 bicycle, 255 void), usually at half size; all void without "
        "semantics"
    )
    label_scale: float = column("label pixels per image pixel (0.5 = half size)")
    sky_fraction: float = column("share of the image with label sky")
    drivable_fraction: float = column("share of the image with label road")
    road_user_boxes_px: np.ndarray = array(
        "<f4", ("N", 4), "detected road users: x0 y0 x1 y1 in full-image pixels"
    )
    road_user_classes: list[str] = column("person, rider, car, truck, bus, train, motorcycle, bicycle")
    road_user_scores: np.ndarray = per_point("0..1")
    road_contrast_png: bytes | None = column(
        "PNG mono8: top-hat contrast inside the road mask (0 outside), at label size; without semantics of the "
        "whole image; null without an image"
    )
    label_gradients: np.ndarray | None = array(
        "<f4",
        (8, 6, 33),
        "image gradients across label borders, by EDGE_* side of objects, then of objects before the sky; by sixth of "
        "the image; by distance, -16 to 16 label pixels; null without an image or semantics",
        default=None,
    )
    steps_png: bytes | None = column(
        "PNG mono8 at label size: steps of brightness as bits STEP_RIGHT and STEP_BELOW; null if the camera has "
        "semantics",
        default=None,
    )


@row()
class SweepFeatureColumns:
    """Features of a sweep."""

    lidar_map_xyz_m: np.ndarray = points("point cloud, uniformly sampled (voxels), with ground; lidar frame")
    lidar_map_is_ground: np.ndarray = per_point(
        "1 = on the drivable ground (RANSAC), for lidar_map_xyz_m", "|u1"
    )
    lidar_map_cluster: np.ndarray = per_point(
        "DBSCAN object cluster of each point, -1 = none, for lidar_map_xyz_m", "<i4"
    )
    lidar_map_time_s: np.ndarray | None = array(
        "<f4",
        ("N",),
        "time of each point of lidar_map_xyz_m relative to stamp_ns; null if perception did not de-skew it",
        default=None,
    )
    lidar_cluster_centre_m: np.ndarray = points("centre (of the cluster's points) of each object cluster")
    lidar_cluster_min_m: np.ndarray = points("lower corner of its axis-aligned box")
    lidar_cluster_max_m: np.ndarray = points("upper corner")
    lidar_edge_xyz_m: np.ndarray = points("depth jumps: foreground range at the mid-beam direction")
    lidar_edge_side: np.ndarray = per_point("EDGE_LEFT/RIGHT/ABOVE/BELOW: side of the foreground", "|u1")
    lidar_edge_jump_m: np.ndarray = per_point("background range minus foreground range")
    lidar_edge_gap_rad: np.ndarray = per_point(
        "angle between the two beams: the edge is within +- half of it"
    )
    lidar_edge_points: np.ndarray = per_point(
        "number of points in the foreground's cluster, a weight; 1 if unknown", "<i4"
    )
    marking_xyz_m: np.ndarray = points("ground points for matching reflectivity with image brightness")
    marking_z: np.ndarray = per_point(
        "reflectivity above its ring or range band [robust standard deviations]"
    )
    ground_plane: np.ndarray | None = array(
        "<f8", (4,), "n.p + d = 0 in the lidar frame, n up; null if no plane was found"
    )
    lidar_drivable_xyz_m: np.ndarray = points("drivable ground on a 1 m grid, lidar frame")


@row()
class ScanFeatureColumns:
    """Features of a radar scan."""

    radar_xyz_m: np.ndarray = points("all detections, radar frame")
    radar_power_db: np.ndarray | None = per_point("power or RCS")
    radar_residual_mps: np.ndarray = per_point(
        "range rate minus that of a static point (wrapped if Doppler is ambiguous)"
    )
    radar_motion: np.ndarray = per_point("0 static, 1 moving, 2 undecided", "|u1")
    radar_cluster: np.ndarray = per_point("cluster of moving detections, -1 = none", "<i4")
    radar_has_elevation: bool = column("as in scans")
    radar_velocity_mps: np.ndarray | None = array(
        "<f8", (3,), "ego velocity of the radar in the radar frame, from the Doppler fit"
    )
    radar_velocity_cov: np.ndarray | None = array("<f8", (3, 3), "covariance of radar_velocity_mps [m2/s2]")
    radar_track_xyz_m: np.ndarray = points("centres of tracked moving clusters, radar frame")
    radar_track_velocity_mps: np.ndarray = points("velocities of the tracks over ground, radar frame axes")
    radar_track_id: np.ndarray = per_point(
        "track id within the drive; a single-frame cluster has a unique id", "<i4"
    )
    radar_track_age: np.ndarray = per_point("number of frames with the track so far", "<i4")
    radar_track_points: np.ndarray = per_point("number of detections in the cluster", "<i4")
    radar_drivable_azimuth_rad: np.ndarray = per_point("bin centres of the free sector, radar frame")
    radar_drivable_range_m: np.ndarray = per_point("drivable up to this range in each bin")


@row()
class ImageFeatures(ImageFeatureColumns, Capture):
    """One row of `image_features`."""


@row()
class SweepFeatures(SweepFeatureColumns, Capture):
    """One row of `sweep_features`."""


@row()
class ScanFeatures(ScanFeatureColumns, Capture):
    """One row of `scan_features`."""


_ONE = "; a file per {}, joined by the table perceived."
IMAGE_FEATURES = TableSchema(
    ImageFeatures, "image_features", 4, "Features of a camera's images" + _ONE.format("camera"),
    made_by="perceive", of_sensor=True,
)  # fmt: skip
SWEEP_FEATURES = TableSchema(
    SweepFeatures, "sweep_features", 1, "Features of a lidar's sweeps" + _ONE.format("lidar"),
    made_by="perceive", of_sensor=True,
)  # fmt: skip
SCAN_FEATURES = TableSchema(
    ScanFeatures, "scan_features", 1, "Features of a radar's scans" + _ONE.format("radar"),
    made_by="perceive", of_sensor=True,
)  # fmt: skip
FEATURES: Final = {"camera": IMAGE_FEATURES, "lidar": SWEEP_FEATURES, "radar": SCAN_FEATURES}
