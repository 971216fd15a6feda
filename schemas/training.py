"""Table `training`: samples for networks, one row per frame, ready to stack; written by prepare, read by train.

All rows of a lake have the same sizes: arrays are padded to a fixed number of rows, and columns `*_count` are the
number of valid ones. Images are resampled once onto an equirectangular grid in the camera's optical frame, which
needs intrinsics but no extrinsics. Lidar and radar stay points, so that they can be rendered at any guess.

The grid: cells are square angles of `grid_step_deg`, centred on the optical axis. The centre of row i, column j is
    azimuth to the LEFT  a = (W/2 - j - 1/2) step      elevation UPWARDS  e = (H/2 - i - 1/2) step
    direction in the optical frame (x right, y down, z forward) = (-sin a cos e, -sin e, cos a cos e),
so azimuth and elevation are those of `pipeline.rig.spherical.camera_direction_angles`.

No column depends on a true transform, and no lidar column on the camera: edges come from ranges, ground from a
plane fitted to the sweep.
"""

from __future__ import annotations

import numpy as np

from schemas.columns import TableSchema, array, column, per_point, points, row

__all__ = [
    "CLASS_OF_LABEL",
    "DISTANCE_GROUPS",
    "GRID_CLASSES",
    "NO_EDGE",
    "POINT_IS_EDGE",
    "POINT_IS_GROUND",
    "SAMPLED",
    "SPLITS",
    "TRAINING",
    "UNKNOWN_CLASS",
    "TrainingRow",
]

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
# Groups whose distance maps are stored: the paper's "reflecting" objects. The minimum over all is the paper's
# mask.
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

_PRIOR_CAMERA_LIDAR = "reference T_camera_lidar: the day's prior, never a truth"
_PRIOR_LIDAR_RADAR = "reference T_lidar_radar: the day's prior, never a truth"


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
    class_distance: np.ndarray = array(
        "|u1",
        (6, "N"),
        "by DISTANCE_GROUPS, each H W: angle to the nearest pixel of the group [0.1 deg], 255 = 25.5 deg or "
        "more",
    )
    edge_offset: np.ndarray = array(
        "|i1",
        (4, "N"),
        "by EDGE_LEFT/RIGHT/ABOVE/BELOW of observations, each H W: signed angle from the cell's centre to the "
        "nearest mask boundary of that direction, along the row (left, right; positive = to the right) or "
        "column (above, below; positive = downwards) [0.05 deg]; NO_EDGE = none within 6.35 deg",
    )
    sky_depth: np.ndarray = per_point("H W: depth inside the sky [0.1 deg], 0 outside it", "|u1")
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
    cluster_xyz_m: np.ndarray = points(
        "uniform sample of the object clusters' points, lidar frame; for losses"
    )
    cluster_id: np.ndarray = per_point("row in cluster_centre_m, -1 = not among its rows", "<i2")
    cluster_point_count: int = column("number of valid rows of cluster_xyz_m", kind="int32")
    cluster_centre_m: np.ndarray = array(
        "<f4", (48, 3), "centres of the largest object clusters, lidar frame"
    )
    cluster_count: int = column("number of valid rows of cluster_centre_m, of 48", kind="int32")
    edge_xyz_m: np.ndarray = points("depth jumps, lidar frame; for losses")
    edge_side: np.ndarray = per_point("EDGE_LEFT/RIGHT/ABOVE/BELOW: side of the foreground", "|u1")
    edge_count: int = column("number of valid rows of edge_*", kind="int32")
    drivable_xyz_m: np.ndarray = array(
        "<f4", (512, 3), "sample of 1 m cells of drivable ground ahead, lidar frame"
    )
    drivable_count: int = column("number of valid rows of drivable_xyz_m, of 512", kind="int32")
    drivable_area_m2: float = column("area that these cells represent")
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
    radar_drivable: np.ndarray = array(
        "|u1",
        (80, 160),
        "drivable area by radar, 255 = certain: x ahead by rows, y from right to left by columns, cells of 1 "
        "m (row r, column c: x = r + 1/2, y = c - 79.5)",
    )
    # the whole
    ego_speed_mps: float = column("as in perceived; 0 if unknown")
    camera_lag_s: float = column("camera_stamp - stamp")
    radar_lag_s: float = column("radar_stamp - stamp")
    prior_camera_lidar_qw: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qx: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qy: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_qz: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_tx_m: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_ty_m: float = column(_PRIOR_CAMERA_LIDAR)
    prior_camera_lidar_tz_m: float = column(_PRIOR_CAMERA_LIDAR)
    prior_lidar_radar_qw: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qx: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qy: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_qz: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_tx_m: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_ty_m: float = column(_PRIOR_LIDAR_RADAR)
    prior_lidar_radar_tz_m: float = column(_PRIOR_LIDAR_RADAR)


TRAINING = TableSchema(
    TrainingRow,
    "training",
    4,
    "One frame per row. Padded rows of arrays are 0.",
    made_by="prepare",
)
