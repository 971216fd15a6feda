"""Table `training`: what a network learns from, one row per frame, ready to stack. From prepare, for train.

Every row of a lake has the same sizes: arrays are padded to a fixed count, and a column ending in `_count` says how
many of their rows are real. The camera is resampled once onto an equirectangular grid in its own optical frame (only
intrinsics are needed for that, no extrinsics); lidar and radar stay points, so that they can be rendered at any guess.

The grid: cells are square angles of `grid_step_deg`, centred on the optical axis. The centre of row i, column j lies at
    azimuth to the LEFT  a = (W/2 - j - 1/2) step      elevation UPWARDS  e = (H/2 - i - 1/2) step
    direction in the optical frame (x right, y down, z forward) = (-sin a cos e, -sin e, cos a cos e),
so azimuth and elevation are those of `pipeline.geometry.spherical.camera_direction_angles`.

No column knows a true transform, and no lidar column knows a camera's class: edges come from ranges, ground from a
plane fitted to the sweep.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from schemas.columns import TableSchema, array, scalar, transform_columns

__all__ = [
    "CLASS_OF_LABEL",
    "DISTANCE_GROUPS",
    "GRID_CLASSES",
    "NO_EDGE",
    "POINT_IS_EDGE",
    "POINT_IS_GROUND",
    "SPLITS",
    "TRAINING",
    "UNKNOWN_CLASS",
    "TrainingRow",
]

SPLITS = ("train", "val", "test")
# Classes of the grid: Cityscapes train ids folded by what they look like to a lidar.
_LABELS_OF_CLASS = {
    "road": (0,),
    "verge": (1, 9),  # sidewalk and terrain: flat, beside the road
    "building": (2, 3),  # and walls
    "fence": (4,),
    "pole": (5, 6, 7),  # poles, lights, signs: thin and upright
    "vegetation": (8,),
    "sky": (10,),
    "person": (11, 12),
    "vehicle": (13, 14, 15, 16),
    "two_wheeler": (17, 18),
}
GRID_CLASSES = tuple(_LABELS_OF_CLASS)
UNKNOWN_CLASS = 255  # in grid_class: void, or outside the image
# Lookup from Cityscapes train ids to classes of the grid.
CLASS_OF_LABEL = np.full(256, UNKNOWN_CLASS, np.uint8)
for _index, _labels in enumerate(_LABELS_OF_CLASS.values()):
    CLASS_OF_LABEL[list(_labels)] = _index
# Groups whose distances are kept: what the paper calls reflecting. The nearest of them all is the paper's mask.
DISTANCE_GROUPS: dict[str, tuple[str, ...]] = {
    "vehicle": ("vehicle",),
    "person": ("person",),
    "two_wheeler": ("two_wheeler",),
    "pole": ("pole",),
    "structure": ("building", "fence"),
    "vegetation": ("vegetation",),
}
POINT_IS_EDGE, POINT_IS_GROUND = 1, 2  # bits of lidar_flags
NO_EDGE = -128  # in edge_offset: no boundary of this direction within reach

TRAINING = TableSchema(
    "training",
    3,
    (
        scalar("frame_index", "int32", "row of table frames"),
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "YYYY-MM-DD"),
        scalar("drive", "int32", "as in frames"),
        scalar("stamp_ns", "int64", "as in frames"),
        scalar("split", "string", "train, val or test"),
        scalar(
            "place", "string", "cell of the map, or stretch of the drive where the log knows no positions"
        ),
        scalar("environment", "string", "of the drive: highway, urban, mixed or unknown"),
        scalar("rig", "string", "rig of fleet.toml"),
        array(
            "fingerprint", "|u1", (32,), "256 signs of brightness steps in the small image: near-duplicates"
        ),
        # the same for all rows of a lake
        scalar("grid_step_deg", "float64", "size of a cell"),
        scalar("grid_height", "int32", "H: rows of the grid"),
        scalar("grid_width", "int32", "W: columns of the grid"),
        # camera, on the grid
        array(
            "image",
            "|u1",
            (3, "N"),
            "red, green, blue; each H W row by row, area-averaged; 0 outside the image",
        ),
        array("grid_class", "|u1", ("N",), "H W: index into GRID_CLASSES, by majority; UNKNOWN_CLASS"),
        array("grid_seen", "|u1", ("N",), "H W: 1 where the image shows the whole cell"),
        array(
            "class_distance",
            "|u1",
            (6, "N"),
            "by DISTANCE_GROUPS, each H W: angle to the nearest pixel of the group [0.1 deg], 255 = 25.5 deg or more",
        ),
        array(
            "edge_offset",
            "|i1",
            (4, "N"),
            "by EDGE_LEFT/RIGHT/ABOVE/BELOW of observations, each H W: signed way from the cell's centre to the "
            "nearest mask boundary of that direction, along the row (left, right; positive = to the right) or column "
            "(above, below; positive = downwards) [0.05 deg]; NO_EDGE = none within 6.35 deg",
        ),
        array("sky_depth", "|u1", ("N",), "H W: depth inside the sky [0.1 deg], 0 outside it"),
        array(
            "detection_box_rad",
            "<f4",
            (24, 4),
            "road users: azimuth left, elevation top, azimuth right, elevation bottom of the box (azimuth to the left "
            "and elevation upwards are positive)",
        ),
        scalar("detection_count", "int32", "road users among the 24 rows"),
        # lidar
        array(
            "lidar_xyz_m",
            "<f4",
            ("N", 3),
            "sweep thinned evenly over directions, lidar frame; input of the network",
        ),
        array(
            "lidar_intensity",
            "|u1",
            ("N",),
            "rank of the reflectivity in its sweep, 0..255; 0 where not logged",
        ),
        array("lidar_flags", "|u1", ("N",), "POINT_IS_EDGE | POINT_IS_GROUND"),
        scalar("lidar_count", "int32", "points among the rows of lidar_*"),
        array(
            "cluster_xyz_m",
            "<f4",
            ("N", 3),
            "uniform sample of the object clusters' points, lidar frame; for losses",
        ),
        array("cluster_id", "<i2", ("N",), "row of cluster_centre_m, -1 = beyond its rows"),
        scalar("cluster_point_count", "int32", "points among the rows of cluster_xyz_m"),
        array("cluster_centre_m", "<f4", (48, 3), "centres of the largest object clusters, lidar frame"),
        scalar("cluster_count", "int32", "clusters among the 48 rows"),
        array("edge_xyz_m", "<f4", ("N", 3), "depth jumps, lidar frame; for losses"),
        array("edge_side", "|u1", ("N",), "EDGE_LEFT/RIGHT/ABOVE/BELOW: where the foreground lies"),
        scalar("edge_count", "int32", "jumps among the rows of edge_*"),
        array(
            "drivable_xyz_m", "<f4", (512, 3), "sample of the drivable ground's 1 m cells ahead, lidar frame"
        ),
        scalar("drivable_count", "int32", "cells among the 512 rows"),
        scalar("drivable_area_m2", "float64", "area that they stand for"),
        array(
            "ground_plane", "<f8", (4,), "n.p + d = 0 in the lidar frame, n up; zeros where none was found"
        ),
        # radar
        array("radar_xyz_m", "<f4", (384, 3), "detections, radar frame"),
        array("radar_residual_mps", "<f4", (384,), "Doppler, compensated for the own motion"),
        array(
            "radar_power_db", "<f4", (384,), "power or RCS, less its median in the scan; 0 where not logged"
        ),
        array("radar_motion", "|u1", (384,), "0 static, 1 moving, 2 undecided"),
        scalar("radar_count", "int32", "detections among the 384 rows"),
        scalar("radar_has_elevation", "bool", "False where all elevations are 0"),
        array("track_xyz_m", "<f4", (24, 3), "centres of tracked moving clusters, radar frame"),
        scalar("track_count", "int32", "tracks among the 24 rows"),
        array(
            "radar_drivable",
            "|u1",
            (80, 160),
            "drivable by radar, soft, 255 = surely: x ahead by rows, y from right to left by columns, cells of 1 m "
            "(row r, column c: x = r + 1/2, y = c - 79.5)",
        ),
        # the whole
        scalar("ego_speed_mps", "float64", "as in observations; 0 where unknown"),
        array(
            "way_velocity_mps",
            "<f8",
            (3,),
            "velocity of the radar by Doppler of static detections, radar axes; zeros where unknown",
        ),
        scalar("way_sigma_rad", "float64", "of its elevation, by the scan alone; 0 where unknown"),
        scalar("road_slope", "float64", "of the road under the car along that way, lidar axes; up positive"),
        scalar("camera_lag_s", "float64", "camera_stamp - stamp"),
        scalar("radar_lag_s", "float64", "radar_stamp - stamp"),
        scalar("camera_model", "string", "as in frames, for reference"),
        array("camera_K", "<f8", (3, 3), "as in frames [px]"),
        array("camera_D", "<f8", ("N",), "as in frames"),
        scalar("image_width_px", "int32", "as in frames"),
        scalar("image_height_px", "int32", "as in frames"),
        *transform_columns("prior_camera_lidar_", "reference T_camera_lidar: the day's prior, never a truth"),
        *transform_columns("prior_lidar_radar_", "reference T_lidar_radar: the day's prior, never a truth"),
    ),
    "One frame per row. Padded rows of arrays are 0.",
    made_by="prepare",
    reads_versions=(
        1,
        2,
    ),  # 1 knew no way_* and no road_slope; both hold six columns more, which nothing read
)


@dataclass(frozen=True, eq=False)
class TrainingRow:
    """One row of `training`; fields are the columns of the same name, arrays decoded."""

    frame_index: int
    vehicle: str
    day: str
    drive: int
    stamp_ns: int
    split: str
    place: str
    environment: str
    rig: str
    fingerprint: np.ndarray
    grid_step_deg: float
    grid_height: int
    grid_width: int
    image: np.ndarray
    grid_class: np.ndarray
    grid_seen: np.ndarray
    class_distance: np.ndarray
    edge_offset: np.ndarray
    sky_depth: np.ndarray
    detection_box_rad: np.ndarray
    detection_count: int
    lidar_xyz_m: np.ndarray
    lidar_intensity: np.ndarray
    lidar_flags: np.ndarray
    lidar_count: int
    cluster_xyz_m: np.ndarray
    cluster_id: np.ndarray
    cluster_point_count: int
    cluster_centre_m: np.ndarray
    cluster_count: int
    edge_xyz_m: np.ndarray
    edge_side: np.ndarray
    edge_count: int
    drivable_xyz_m: np.ndarray
    drivable_count: int
    drivable_area_m2: float
    ground_plane: np.ndarray
    radar_xyz_m: np.ndarray
    radar_residual_mps: np.ndarray
    radar_power_db: np.ndarray
    radar_motion: np.ndarray
    radar_count: int
    radar_has_elevation: bool
    track_xyz_m: np.ndarray
    track_count: int
    radar_drivable: np.ndarray
    ego_speed_mps: float
    camera_lag_s: float
    radar_lag_s: float
    camera_model: str
    camera_K: np.ndarray
    camera_D: np.ndarray
    image_width_px: int
    image_height_px: int
    prior_camera_lidar_qw: float
    prior_camera_lidar_qx: float
    prior_camera_lidar_qy: float
    prior_camera_lidar_qz: float
    prior_camera_lidar_tx_m: float
    prior_camera_lidar_ty_m: float
    prior_camera_lidar_tz_m: float
    prior_lidar_radar_qw: float
    prior_lidar_radar_qx: float
    prior_lidar_radar_qy: float
    prior_lidar_radar_qz: float
    prior_lidar_radar_tx_m: float
    prior_lidar_radar_ty_m: float
    prior_lidar_radar_tz_m: float
    way_velocity_mps: np.ndarray = field(default_factory=lambda: np.zeros(3))
    way_sigma_rad: float = 0.0
    road_slope: float = 0.0
