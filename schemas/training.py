"""Table `training`: samples for networks, one row per frame, ready to stack; written by prepare, read by train.

All rows of a lake have the same sizes: arrays are padded to a fixed number of rows, and columns `*_count` are the
number of valid ones. Images are resampled once onto an equirectangular grid in the camera's optical frame, which
needs intrinsics but no extrinsics. Lidar and radar stay points, so that they can be rendered at any guess.

The grid: cells are square angles of `grid_step_deg`, centred on the optical axis. The centre of row i, column j is
    azimuth to the LEFT  a = (W/2 - j - 1/2) step      elevation UPWARDS  e = (H/2 - i - 1/2) step
    direction in the optical frame (x right, y down, z forward) = (-sin a cos e, -sin e, cos a cos e),
so azimuth and elevation are those of `pipeline.rig.se3.camera_direction_angles`.

No column depends on a true transform, and no lidar column on the camera: edges come from ranges, ground from a
plane fitted to the sweep.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import TableSchema, array, column, per_point, points, row

__all__ = [
    "CLASS_OF_LABEL", "GRID_CLASSES", "NO_EDGE", "POINT_IS_EDGE", "POINT_IS_GROUND", "SAMPLED", "SPLITS",
    "TRAINING", "UNKNOWN_CLASS", "TrainingRow",
]  # fmt: skip

SPLITS = ("train", "val", "test")
# Key in the manifest's `extra`: names of the camera, lidar and radar of the samples, by kind.
SAMPLED = "sensors"
# Classes of the grid: Cityscapes train ids, merged if they look alike to a lidar.
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
POINT_IS_EDGE, POINT_IS_GROUND = 1, 2  # bits of lidar_flags
NO_EDGE = -128  # in edge_offset: no boundary of this direction within reach

_CAMERA_LIDAR = "T_camera_lidar of `reference`; never a truth"
_LIDAR_RADAR = "T_lidar_radar of `reference`; never a truth"


@row(eq=False)
class TrainingRow:
    """One row of `training`; fields are the columns of the same name, arrays decoded."""

    frame_index: int = column("row of table moments", kind="int32")
    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    drive: int = column("as in moments", kind="int32")
    stamp_ns: int = column("as in moments")
    split: str = column("train, val or test")
    place: str = column("cell of the map, or stretch of the drive if the log has no positions")
    environment: str = column("of the drive: highway, urban, mixed or unknown")
    rig: str = column("rig of fleet.toml")
    fingerprint: np.ndarray = array(
        "|u1", (32,), "256 signs of brightness steps in the small image: near-duplicates"
    )
    # the same for all rows of a lake
    grid_step_deg: float = column("size of a cell")
    grid_height: int = column("H: rows of the grid", kind="int32")
    grid_width: int = column("W: columns of the grid", kind="int32")
    # camera, on the grid
    image: np.ndarray = array(
        "|u1", (3, "N"), "red, green, blue; each H W row by row, area-averaged; 0 outside the image"
    )
    grid_class: np.ndarray = per_point("H W: index into GRID_CLASSES, by majority, or UNKNOWN_CLASS", "|u1")
    grid_seen: np.ndarray = per_point("H W: 1 if the image shows the whole cell", "|u1")
    edge_offset: np.ndarray = array(
        "|i1",
        (4, "N"),
        "by EDGE_LEFT/RIGHT/ABOVE/BELOW of observations, each H W: signed angle from the cell's centre to the "
        "nearest mask boundary of that direction, along the row (left, right; positive = to the right) or "
        "column (above, below; positive = downwards) [0.05 deg]; NO_EDGE = none within 6.35 deg",
    )
    detection_box_rad: np.ndarray = array(
        "<f4",
        (24, 4),
        "road users: azimuth left, elevation top, azimuth right, elevation bottom of the box (azimuth to the "
        "left and elevation upwards are positive)",
    )
    detection_count: int = column("number of valid rows of detection_box_rad, of 24", kind="int32")
    # lidar
    lidar_xyz_m: np.ndarray = points(
        "sweep thinned evenly over directions, lidar frame; input of the network"
    )
    lidar_intensity: np.ndarray = per_point(
        "rank of the reflectivity in its sweep, 0..255; 0 if not logged", "|u1"
    )
    lidar_flags: np.ndarray = per_point("POINT_IS_EDGE | POINT_IS_GROUND", "|u1")
    lidar_count: int = column("number of valid rows of lidar_*", kind="int32")
    cluster_centre_m: np.ndarray = array(
        "<f4", (48, 3), "centres of the largest object clusters, lidar frame"
    )
    cluster_count: int = column("number of valid rows of cluster_centre_m, of 48", kind="int32")
    edge_xyz_m: np.ndarray = points("depth jumps, lidar frame; for losses")
    edge_side: np.ndarray = per_point("EDGE_LEFT/RIGHT/ABOVE/BELOW: side of the foreground", "|u1")
    edge_count: int = column("number of valid rows of edge_*", kind="int32")
    ground_plane: np.ndarray = array(
        "<f8", (4,), "n.p + d = 0 in the lidar frame, n up; zeros if none was found"
    )
    # radar
    radar_xyz_m: np.ndarray = array("<f4", (384, 3), "detections, radar frame")
    radar_residual_mps: np.ndarray = array("<f4", (384,), "Doppler, compensated for ego motion")
    radar_power_db: np.ndarray = array(
        "<f4", (384,), "power or RCS minus its median in the scan; 0 if not logged"
    )
    radar_motion: np.ndarray = array("|u1", (384,), "0 static, 1 moving, 2 undecided")
    radar_count: int = column("number of valid rows of radar_*, of 384", kind="int32")
    radar_has_elevation: bool = column("False if all elevations are 0")
    track_xyz_m: np.ndarray = array("<f4", (24, 3), "centres of tracked moving clusters, radar frame")
    track_count: int = column("number of valid rows of track_xyz_m, of 24", kind="int32")
    # the whole
    ego_velocity_mps: np.ndarray = array("<f4", (3,), "own velocity in the lidar frame; 0 if unknown")
    ego_yaw_rate_radps: float = column("as in perceived; 0 if unknown")
    camera_lag_s: float = column("time of the image after `stamp_ns`, by the lidar's clock")
    radar_lag_s: float = column("time of the scan after `stamp_ns`, by the lidar's clock")
    reference: str = column(
        "joint: poses and clocks of the day's record of joint (accepted, or held for its sigma alone); prior: those "
        "before the day"
    )
    reference_camera_lidar_qw: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_qx: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_qy: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_qz: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_tx_m: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_ty_m: float = column(_CAMERA_LIDAR)
    reference_camera_lidar_tz_m: float = column(_CAMERA_LIDAR)
    reference_lidar_radar_qw: float = column(_LIDAR_RADAR)
    reference_lidar_radar_qx: float = column(_LIDAR_RADAR)
    reference_lidar_radar_qy: float = column(_LIDAR_RADAR)
    reference_lidar_radar_qz: float = column(_LIDAR_RADAR)
    reference_lidar_radar_tx_m: float = column(_LIDAR_RADAR)
    reference_lidar_radar_ty_m: float = column(_LIDAR_RADAR)
    reference_lidar_radar_tz_m: float = column(_LIDAR_RADAR)


TRAINING = TableSchema(
    TrainingRow, "training", 5, "One frame per row. Padded rows of arrays are 0.", made_by="prepare"
)
