"""Table `frames`: one row per moment that synchronised sensors of a vehicle-day saw. From ingest, for perceive."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from schemas.calibrations import SENSORS
from schemas.columns import TableSchema, array, scalar, transform_columns

__all__ = [
    "FRAMES",
    "SAME_SCENE_NS",
    "SENSORS_ABSENT",
    "SWEEPS_LOGGED",
    "SWEEPS_PLANNED",
    "SWEEPS_READ",
    "Frame",
]

# Among the manifest's kept, of a day that was read in bursts: sweeps that its logs hold by their indices, that the
# plan was about, and that were read.
SWEEPS_LOGGED, SWEEPS_PLANNED, SWEEPS_READ = "sweeps_in_logs", "sweeps_planned", "sweeps_read"
# Among the manifest's extra: why moments lack a sensor, in words by sensor.
SENSORS_ABSENT = "sensors_absent"
# Moments nearer in time than this show the same scene: one without all sensors adds nothing to a whole one beside it.
SAME_SCENE_NS = 10**9

FRAMES = TableSchema(
    "frames",
    2,
    (
        scalar("frame_index", "int32", "0, 1, 2, ... in order of stamp within the vehicle-day"),
        scalar("log", "string", "file name of the log that the moment came from"),
        scalar(
            "drive",
            "int32",
            "continuous stretch of driving; grows where the log changes or stamps gap by more than 10 s",
        ),
        scalar(
            "sensors",
            "list<string>",
            "of camera, lidar and radar those that the moment has; of another one arrays and bytes are empty, camera_K "
            "is NaN and the stamp is the moment's. All three in rows of version 1",
        ),
        scalar("stamp_ns", "int64", "the moment's time = the lidar's stamp, the radar's where no sweep is"),
        scalar("camera_stamp_ns", "int64", "stamp of the image"),
        scalar("lidar_stamp_ns", "int64", "stamp of the sweep; per-point times count from it"),
        scalar("radar_stamp_ns", "int64", "stamp of the radar scan"),
        scalar(
            "image", "binary", "JPEG or PNG bytes exactly as logged (raw Image topics are encoded as PNG)"
        ),
        scalar("image_format", "string", "'jpeg' or 'png'"),
        scalar("image_width_px", "int32", "width that the intrinsics refer to"),
        scalar("image_height_px", "int32", "height that the intrinsics refer to"),
        scalar(
            "camera_model",
            "string",
            "'plumb_bob', 'rational_polynomial' or 'equidistant' (Kannala-Brandt; D = 0 is f-theta)",
        ),
        array("camera_K", "<f8", (3, 3), "camera matrix [px]"),
        array("camera_D", "<f8", ("N",), "distortion coefficients in ROS order"),
        scalar(
            "labels_png",
            "binary",
            "logged semantic label image, PNG mono8, labels of the config's label_set",
            nullable=True,
        ),
        array(
            "detection_boxes_px",
            "<f4",
            ("N", 4),
            "logged road users: x0 y0 x1 y1 in full-image pixels",
            nullable=True,
        ),
        scalar("detection_classes", "list<string>", "their classes as logged", nullable=True),
        array("detection_scores", "<f4", ("N",), "their scores, 0..1", nullable=True),
        array(
            "lidar_x_m",
            "<f4",
            ("N",),
            "points in the lidar frame, de-skewed to lidar_stamp_ns where lidar_deskewed",
        ),
        array("lidar_y_m", "<f4", ("N",), "see lidar_x_m"),
        array("lidar_z_m", "<f4", ("N",), "see lidar_x_m"),
        array("lidar_intensity", "<f4", ("N",), "reflectivity as logged", nullable=True),
        array("lidar_ring", "<u2", ("N",), "beam number", nullable=True),
        array("lidar_time_s", "<f4", ("N",), "time of each point relative to lidar_stamp_ns", nullable=True),
        scalar("lidar_deskewed", "bool", "points were moved to lidar_stamp_ns by the ego motion"),
        array("radar_x_m", "<f4", ("N",), "detections in the radar frame"),
        array("radar_y_m", "<f4", ("N",), "see radar_x_m"),
        array("radar_z_m", "<f4", ("N",), "see radar_x_m; 0 where the radar measures no elevation"),
        array(
            "radar_range_rate_mps",
            "<f4",
            ("N",),
            "Doppler as range rate: positive = receding, whatever the log's sign; not ego-compensated",
        ),
        array("radar_power_db", "<f4", ("N",), "power or RCS as logged", nullable=True),
        scalar("radar_has_elevation", "bool", "False where all elevations are 0"),
        scalar(
            "doppler_period_mps",
            "float64",
            "range rates are known modulo this; null = unambiguous",
            nullable=True,
        ),
        scalar("ego_speed_mps", "float64", "forward speed from odometry at stamp_ns", nullable=True),
        scalar(
            "ego_yaw_rate_radps", "float64", "yaw rate from odometry, positive to the left", nullable=True
        ),
        *transform_columns("ego_", "T_odom_vehicle at stamp_ns from odometry", nullable=True),
        *transform_columns(
            "prior_camera_lidar_", "T_camera_lidar from tf_static or the prior file", nullable=True
        ),
        *transform_columns(
            "prior_lidar_radar_", "T_lidar_radar from tf_static or the prior file", nullable=True
        ),
        *transform_columns(
            "prior_camera_radar_", "T_camera_radar likewise, where the moment has no lidar", nullable=True
        ),
    ),
    "One moment per row, in order of stamp. Camera: optical frame; lidar and radar: x forward, y left, z up.",
    made_by="ingest",
    reads_versions=(1,),
)


@dataclass(frozen=True, eq=False)
class Frame:
    """One row of `frames`; fields are the columns of the same name, arrays decoded. Fields named as in FRAMES."""

    frame_index: int
    log: str
    drive: int
    stamp_ns: int
    camera_stamp_ns: int
    lidar_stamp_ns: int
    radar_stamp_ns: int
    image: bytes
    image_format: str
    image_width_px: int
    image_height_px: int
    camera_model: str
    camera_K: np.ndarray
    camera_D: np.ndarray
    labels_png: bytes | None
    detection_boxes_px: np.ndarray | None
    detection_classes: list[str] | None
    detection_scores: np.ndarray | None
    lidar_x_m: np.ndarray
    lidar_y_m: np.ndarray
    lidar_z_m: np.ndarray
    lidar_intensity: np.ndarray | None
    lidar_ring: np.ndarray | None
    lidar_time_s: np.ndarray | None
    lidar_deskewed: bool
    radar_x_m: np.ndarray
    radar_y_m: np.ndarray
    radar_z_m: np.ndarray
    radar_range_rate_mps: np.ndarray
    radar_power_db: np.ndarray | None
    radar_has_elevation: bool
    doppler_period_mps: float | None
    ego_speed_mps: float | None
    ego_yaw_rate_radps: float | None
    ego_qw: float | None
    ego_qx: float | None
    ego_qy: float | None
    ego_qz: float | None
    ego_tx_m: float | None
    ego_ty_m: float | None
    ego_tz_m: float | None
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
    prior_camera_radar_qw: float | None = None
    prior_camera_radar_qx: float | None = None
    prior_camera_radar_qy: float | None = None
    prior_camera_radar_qz: float | None = None
    prior_camera_radar_tx_m: float | None = None
    prior_camera_radar_ty_m: float | None = None
    prior_camera_radar_tz_m: float | None = None
    sensors: list[str] = field(default_factory=lambda: list(SENSORS))

    @property
    def lidar_xyz_m(self) -> Float32[np.ndarray, "N 3"]:
        """Lidar points [m], lidar frame."""
        return np.stack([self.lidar_x_m, self.lidar_y_m, self.lidar_z_m], axis=-1)

    @property
    def radar_xyz_m(self) -> Float32[np.ndarray, "M 3"]:
        """Radar detections [m], radar frame."""
        return np.stack([self.radar_x_m, self.radar_y_m, self.radar_z_m], axis=-1)
