"""Table `observations`: what perception found in each frame. Written by perceive; calibrate needs nothing else."""

from __future__ import annotations

import numpy as np

from schemas.calibrations import SENSORS
from schemas.columns import array, column, row, table_of

__all__ = ["EDGE_ABOVE", "EDGE_BELOW", "EDGE_LEFT", "EDGE_RIGHT", "OBSERVATIONS", "Observation"]

# Direction class of a depth jump or mask boundary, always as seen in the image: on which side of the boundary the
# FOREGROUND (the nearer surface, or the object's mask) lies. Jumps and boundaries match only in the same class.
EDGE_LEFT, EDGE_RIGHT, EDGE_ABOVE, EDGE_BELOW = 0, 1, 2, 3

_PRIOR_CAMERA_LIDAR = "as in frames"
_PRIOR_LIDAR_RADAR = "as in frames"
_PRIOR_CAMERA_RADAR = "as in frames"


@row(eq=False)
class Observation:
    """One row of `observations`; fields are the columns of the same name, arrays decoded."""

    frame_index: int = column("row of table frames", kind="int32")
    log: str = column("as in frames")
    drive: int = column("as in frames: the block of the bootstrap", kind="int32")
    sensors: list[str] = column(
        "as in frames, less those whose image, sweep or scan was of no use; what they would show is empty",
        default_factory=lambda: list(SENSORS),
    )
    stamp_ns: int = column("as in frames")
    camera_stamp_ns: int = column("as in frames")
    radar_stamp_ns: int = column("as in frames")
    image_width_px: int = column("as in frames", kind="int32")
    image_height_px: int = column("as in frames", kind="int32")
    camera_model: str = column("as in frames")
    camera_K: np.ndarray = array("<f8", (3, 3), "as in frames [px]")
    camera_D: np.ndarray = array("<f8", ("N",), "as in frames")
    prior_camera_lidar_qw: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qx: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qy: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qz: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_tx_m: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_ty_m: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_tz_m: float | None = column(_PRIOR_CAMERA_LIDAR)
    prior_lidar_radar_qw: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qx: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qy: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qz: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_tx_m: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_ty_m: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_tz_m: float | None = column(_PRIOR_LIDAR_RADAR)
    prior_camera_radar_qw: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_qx: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_qy: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_qz: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_tx_m: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_ty_m: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    prior_camera_radar_tz_m: float | None = column(_PRIOR_CAMERA_RADAR, default=None)
    ego_speed_mps: float | None = column(
        "from odometry where logged, else from the Doppler fit of the static world"
    )
    ego_yaw_rate_radps: float | None = column("from odometry, else null")
    # camera
    labels_png: bytes = column(
        "PNG mono8 of Cityscapes train ids (0 road .. 18 bicycle, 255 void), usually at half size"
    )
    label_scale: float = column("label pixels per image pixel (0.5 = half size)")
    sky_fraction: float = column("share of the image labelled sky")
    drivable_fraction: float = column("share of the image labelled road")
    road_user_boxes_px: np.ndarray = array(
        "<f4", ("N", 4), "detected road users: x0 y0 x1 y1 in full-image pixels"
    )
    road_user_classes: list[str] = column("person, rider, car, truck, bus, train, motorcycle, bicycle")
    road_user_scores: np.ndarray = array("<f4", ("N",), "0..1")
    road_contrast_png: bytes | None = column(
        "PNG mono8: top-hat contrast inside the road mask (0 outside), at label size; null without an image"
    )
    label_gradients: np.ndarray | None = array(
        "<f4",
        (4, 6, 33),
        (
            "image gradients across the labels' borders: by EDGE_* side, sixth of the image and distance from -16"
            " to 16 label pixels; null in version 1"
        ),
        default=None,
    )
    # lidar
    lidar_map_xyz_m: np.ndarray = array(
        "<f4", ("N", 3), "the cloud, uniformly sampled (voxels), ground kept; lidar frame"
    )
    lidar_map_is_ground: np.ndarray = array(
        "|u1", ("N",), "1 = on the drivable ground (RANSAC), for lidar_map_xyz_m"
    )
    lidar_map_cluster: np.ndarray = array(
        "<i4", ("N",), "DBSCAN object cluster of each point, -1 = none, for lidar_map_xyz_m"
    )
    lidar_map_time_s: np.ndarray | None = array(
        "<f4",
        ("N",),
        "when each point was measured, against stamp_ns, for lidar_map_xyz_m; null where not de-skewed here",
        default=None,
    )
    lidar_cluster_centre_m: np.ndarray = array(
        "<f4", ("N", 3), "centre (of the cluster's points) of each object cluster"
    )
    lidar_cluster_min_m: np.ndarray = array("<f4", ("N", 3), "lower corner of its axis-aligned box")
    lidar_cluster_max_m: np.ndarray = array("<f4", ("N", 3), "upper corner")
    lidar_edge_xyz_m: np.ndarray = array(
        "<f4", ("N", 3), "depth jumps: foreground range at the mid-beam direction"
    )
    lidar_edge_side: np.ndarray = array(
        "|u1", ("N",), "EDGE_LEFT/RIGHT/ABOVE/BELOW: where the foreground lies"
    )
    lidar_edge_jump_m: np.ndarray = array("<f4", ("N",), "background range minus foreground range")
    lidar_edge_gap_rad: np.ndarray = array(
        "<f4", ("N",), "angle between the two beams: the edge lies within +- half of it"
    )
    lidar_edge_points: np.ndarray = array(
        "<i4", ("N",), "points of the foreground's object (its cluster), a weight; 1 where unknown"
    )
    marking_xyz_m: np.ndarray = array(
        "<f4", ("N", 3), "ground points, for reflectivity against image brightness"
    )
    marking_z: np.ndarray = array(
        "<f4", ("N",), "how far the reflectivity stands out of its ring or range band [robust sd]"
    )
    ground_plane: np.ndarray | None = array(
        "<f8", (4,), "n.p + d = 0 in the lidar frame, n up; null where no plane was found"
    )
    lidar_drivable_xyz_m: np.ndarray = array("<f4", ("N", 3), "drivable ground on a 1 m grid, lidar frame")
    # radar
    radar_xyz_m: np.ndarray = array("<f4", ("N", 3), "all detections, radar frame")
    radar_power_db: np.ndarray | None = array("<f4", ("N",), "power or RCS")
    radar_residual_mps: np.ndarray = array(
        "<f4", ("N",), "range rate minus what a static point would have (wrapped where Doppler is ambiguous)"
    )
    radar_motion: np.ndarray = array("|u1", ("N",), "0 static, 1 moving, 2 undecided")
    radar_cluster: np.ndarray = array("<i4", ("N",), "cluster of moving detections, -1 = none")
    radar_has_elevation: bool = column("as in frames")
    radar_velocity_mps: np.ndarray | None = array(
        "<f8", (3,), "the radar's own velocity in the radar frame, from the Doppler fit"
    )
    radar_velocity_cov: np.ndarray | None = array("<f8", (3, 3), "its covariance [m2/s2]")
    radar_track_xyz_m: np.ndarray = array("<f4", ("N", 3), "centres of tracked moving clusters, radar frame")
    radar_track_velocity_mps: np.ndarray = array(
        "<f4", ("N", 3), "their velocity over ground, radar frame axes"
    )
    radar_track_id: np.ndarray = array(
        "<i4", ("N",), "identity within the drive; a single-frame cluster has an id of its own"
    )
    radar_track_age: np.ndarray = array("<i4", ("N",), "frames in which the track was seen so far")
    radar_track_points: np.ndarray = array("<i4", ("N",), "detections in the cluster")
    radar_drivable_azimuth_rad: np.ndarray = array(
        "<f4", ("N",), "bin centres of the free sector, radar frame"
    )
    radar_drivable_range_m: np.ndarray = array("<f4", ("N",), "drivable until this range in each bin")


OBSERVATIONS = table_of(
    Observation,
    "observations",
    3,
    "Perception of one frame per row; points stay in the frame of the sensor that saw them.",
    made_by="perceive",
    # 1 knew no label_gradients, and saw with all three sensors; 2 knew no times of points.
    reads_versions=(1, 2),
)
