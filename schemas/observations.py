"""Table `observations`: what perception found in each frame. Written by perceive; calibrate needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from schemas.calibrations import SENSORS
from schemas.columns import TableSchema, array, scalar, transform_columns

__all__ = ["EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "OBSERVATIONS", "Observation"]

# Direction class of a depth jump or mask boundary, always as seen in the image: on which side of the boundary the
# FOREGROUND (the nearer surface, or the object's mask) lies. Jumps and boundaries match only in the same class.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3

OBSERVATIONS = TableSchema(
    "observations",
    2,
    (
        scalar("frame_index", "int32", "row of table frames"),
        scalar("log", "string", "as in frames"),
        scalar("drive", "int32", "as in frames: the block of the bootstrap"),
        scalar(
            "sensors",
            "list<string>",
            "as in frames, less those whose image, sweep or scan was of no use; what they would show is empty",
        ),
        scalar("stamp_ns", "int64", "as in frames"),
        scalar("camera_stamp_ns", "int64", "as in frames"),
        scalar("radar_stamp_ns", "int64", "as in frames"),
        scalar("image_width_px", "int32", "as in frames"),
        scalar("image_height_px", "int32", "as in frames"),
        scalar("camera_model", "string", "as in frames"),
        array("camera_K", "<f8", (3, 3), "as in frames [px]"),
        array("camera_D", "<f8", ("N",), "as in frames"),
        *transform_columns("prior_camera_lidar_", "as in frames", nullable=True),
        *transform_columns("prior_lidar_radar_", "as in frames", nullable=True),
        *transform_columns("prior_camera_radar_", "as in frames", nullable=True),
        scalar(
            "ego_speed_mps",
            "float64",
            "from odometry where logged, else from the Doppler fit of the static world",
            nullable=True,
        ),
        scalar("ego_yaw_rate_radps", "float64", "from odometry, else null", nullable=True),
        # camera
        scalar(
            "labels_png",
            "binary",
            "PNG mono8 of Cityscapes train ids (0 road .. 18 bicycle, 255 void), usually at half size",
        ),
        scalar("label_scale", "float64", "label pixels per image pixel (0.5 = half size)"),
        scalar("sky_fraction", "float64", "share of the image labelled sky"),
        scalar("drivable_fraction", "float64", "share of the image labelled road"),
        array("road_user_boxes_px", "<f4", ("N", 4), "detected road users: x0 y0 x1 y1 in full-image pixels"),
        scalar(
            "road_user_classes", "list<string>", "person, rider, car, truck, bus, train, motorcycle, bicycle"
        ),
        array("road_user_scores", "<f4", ("N",), "0..1"),
        scalar(
            "road_contrast_png",
            "binary",
            "PNG mono8: top-hat contrast inside the road mask (0 outside), at label size; null without an image",
            nullable=True,
        ),
        array(
            "label_gradients",
            "<f4",
            (4, 6, 33),
            "image gradients across the labels' borders: by EDGE_* side, sixth of the image and distance "
            "from -16 to 16 label pixels; null in version 1",
            nullable=True,
        ),
        # lidar
        array(
            "lidar_map_xyz_m",
            "<f4",
            ("N", 3),
            "the cloud, uniformly sampled (voxels), ground kept; lidar frame",
        ),
        array(
            "lidar_map_is_ground", "|u1", ("N",), "1 = on the drivable ground (RANSAC), for lidar_map_xyz_m"
        ),
        array(
            "lidar_map_cluster",
            "<i4",
            ("N",),
            "DBSCAN object cluster of each point, -1 = none, for lidar_map_xyz_m",
        ),
        array(
            "lidar_cluster_centre_m",
            "<f4",
            ("N", 3),
            "centre (of the cluster's points) of each object cluster",
        ),
        array("lidar_cluster_min_m", "<f4", ("N", 3), "lower corner of its axis-aligned box"),
        array("lidar_cluster_max_m", "<f4", ("N", 3), "upper corner"),
        array("lidar_edge_xyz_m", "<f4", ("N", 3), "depth jumps: foreground range at the mid-beam direction"),
        array("lidar_edge_side", "|u1", ("N",), "EDGE_LEFT/RIGHT/ABOVE/BELOW: where the foreground lies"),
        array("lidar_edge_jump_m", "<f4", ("N",), "background range minus foreground range"),
        array(
            "lidar_edge_gap_rad",
            "<f4",
            ("N",),
            "angle between the two beams: the edge lies within +- half of it",
        ),
        array(
            "lidar_edge_points",
            "<i4",
            ("N",),
            "points of the foreground's object (its cluster), a weight; 1 where unknown",
        ),
        array("marking_xyz_m", "<f4", ("N", 3), "ground points, for reflectivity against image brightness"),
        array(
            "marking_z",
            "<f4",
            ("N",),
            "how far the reflectivity stands out of its ring or range band [robust sd]",
        ),
        array(
            "ground_plane",
            "<f8",
            (4,),
            "n.p + d = 0 in the lidar frame, n up; null where no plane was found",
            nullable=True,
        ),
        array("lidar_drivable_xyz_m", "<f4", ("N", 3), "drivable ground on a 1 m grid, lidar frame"),
        # radar
        array("radar_xyz_m", "<f4", ("N", 3), "all detections, radar frame"),
        array("radar_power_db", "<f4", ("N",), "power or RCS", nullable=True),
        array(
            "radar_residual_mps",
            "<f4",
            ("N",),
            "range rate minus what a static point would have (wrapped where Doppler is ambiguous)",
        ),
        array("radar_motion", "|u1", ("N",), "0 static, 1 moving, 2 undecided"),
        array("radar_cluster", "<i4", ("N",), "cluster of moving detections, -1 = none"),
        scalar("radar_has_elevation", "bool", "as in frames"),
        array(
            "radar_velocity_mps",
            "<f8",
            (3,),
            "the radar's own velocity in the radar frame, from the Doppler fit",
            nullable=True,
        ),
        array("radar_velocity_cov", "<f8", (3, 3), "its covariance [m2/s2]", nullable=True),
        array("radar_track_xyz_m", "<f4", ("N", 3), "centres of tracked moving clusters, radar frame"),
        array("radar_track_velocity_mps", "<f4", ("N", 3), "their velocity over ground, radar frame axes"),
        array(
            "radar_track_id",
            "<i4",
            ("N",),
            "identity within the drive; a single-frame cluster has an id of its own",
        ),
        array("radar_track_age", "<i4", ("N",), "frames in which the track was seen so far"),
        array("radar_track_points", "<i4", ("N",), "detections in the cluster"),
        array("radar_drivable_azimuth_rad", "<f4", ("N",), "bin centres of the free sector, radar frame"),
        array("radar_drivable_range_m", "<f4", ("N",), "drivable until this range in each bin"),
    ),
    "Perception of one frame per row; points stay in the frame of the sensor that saw them.",
    made_by="perceive",
    reads_versions=(1,),  # which knew no label_gradients, and saw with all three sensors
)


@dataclass(frozen=True, eq=False)
class Observation:
    """One row of `observations`; fields are the columns of the same name, arrays decoded."""

    frame_index: int
    log: str
    drive: int
    stamp_ns: int
    camera_stamp_ns: int
    radar_stamp_ns: int
    image_width_px: int
    image_height_px: int
    camera_model: str
    camera_K: np.ndarray
    camera_D: np.ndarray
    prior_camera_lidar_qw: float | None
    prior_camera_lidar_qx: float | None
    prior_camera_lidar_qy: float | None
    prior_camera_lidar_qz: float | None
    prior_camera_lidar_tx_m: float | None
    prior_camera_lidar_ty_m: float | None
    prior_camera_lidar_tz_m: float | None
    prior_lidar_radar_qw: float | None
    prior_lidar_radar_qx: float | None
    prior_lidar_radar_qy: float | None
    prior_lidar_radar_qz: float | None
    prior_lidar_radar_tx_m: float | None
    prior_lidar_radar_ty_m: float | None
    prior_lidar_radar_tz_m: float | None
    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
    labels_png: bytes
    label_scale: float
    sky_fraction: float
    drivable_fraction: float
    road_user_boxes_px: np.ndarray
    road_user_classes: list[str]
    road_user_scores: np.ndarray
    road_contrast_png: bytes | None
    lidar_map_xyz_m: np.ndarray
    lidar_map_is_ground: np.ndarray
    lidar_map_cluster: np.ndarray
    lidar_cluster_centre_m: np.ndarray
    lidar_cluster_min_m: np.ndarray
    lidar_cluster_max_m: np.ndarray
    lidar_edge_xyz_m: np.ndarray
    lidar_edge_side: np.ndarray
    lidar_edge_jump_m: np.ndarray
    lidar_edge_gap_rad: np.ndarray
    lidar_edge_points: np.ndarray
    marking_xyz_m: np.ndarray
    marking_z: np.ndarray
    ground_plane: np.ndarray | None
    lidar_drivable_xyz_m: np.ndarray
    radar_xyz_m: np.ndarray
    radar_power_db: np.ndarray | None
    radar_residual_mps: np.ndarray
    radar_motion: np.ndarray
    radar_cluster: np.ndarray
    radar_has_elevation: bool
    radar_velocity_mps: np.ndarray | None
    radar_velocity_cov: np.ndarray | None
    radar_track_xyz_m: np.ndarray
    radar_track_velocity_mps: np.ndarray
    radar_track_id: np.ndarray
    radar_track_age: np.ndarray
    radar_track_points: np.ndarray
    radar_drivable_azimuth_rad: np.ndarray
    radar_drivable_range_m: np.ndarray
    label_gradients: np.ndarray | None = None
    prior_camera_radar_qw: float | None = None
    prior_camera_radar_qx: float | None = None
    prior_camera_radar_qy: float | None = None
    prior_camera_radar_qz: float | None = None
    prior_camera_radar_tx_m: float | None = None
    prior_camera_radar_ty_m: float | None = None
    prior_camera_radar_tz_m: float | None = None
    sensors: list[str] = field(default_factory=lambda: list(SENSORS))
