"""Table `frames`: one row per moment that synchronised sensors of a vehicle-day saw. From ingest, for perceive."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from schemas.calibrations import SENSORS
from schemas.columns import array, column, row, table_of

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

_EGO = "T_odom_vehicle at stamp_ns from odometry"
_PRIOR_CAMERA_LIDAR = "T_camera_lidar from tf_static or the prior file"
_PRIOR_LIDAR_RADAR = "T_lidar_radar from tf_static or the prior file"
_PRIOR_CAMERA_RADAR = "T_camera_radar likewise, where the moment has no lidar"


@row(eq=False)
class Frame:
    """One row of `frames`; fields are the columns of the same name, arrays decoded. Fields named as in FRAMES."""

    frame_index: int = column("0, 1, 2, ... in order of stamp within the vehicle-day", kind="int32")
    log: str = column("file name of the log that the moment came from")
    drive: int = column(
        "continuous stretch of driving; grows where the log changes or stamps gap by more than 10 s",
        kind="int32",
    )
    sensors: list[str] = column(
        (
            "of camera, lidar and radar those that the moment has; of another one arrays and bytes are empty, "
            "camera_K is NaN and the stamp is the moment's. All three in rows of version 1"
        ),
        default_factory=lambda: list(SENSORS),
    )
    stamp_ns: int = column("the moment's time = the lidar's stamp, the radar's where no sweep is")
    camera_stamp_ns: int = column("stamp of the image")
    lidar_stamp_ns: int = column("stamp of the sweep; per-point times count from it")
    radar_stamp_ns: int = column("stamp of the radar scan")
    image: bytes = column("JPEG or PNG bytes exactly as logged (raw Image topics are encoded as PNG)")
    image_format: str = column("'jpeg' or 'png'")
    image_width_px: int = column("width that the intrinsics refer to", kind="int32")
    image_height_px: int = column("height that the intrinsics refer to", kind="int32")
    camera_model: str = column(
        "'plumb_bob', 'rational_polynomial' or 'equidistant' (Kannala-Brandt; D = 0 is f-theta)"
    )
    camera_K: np.ndarray = array("<f8", (3, 3), "camera matrix [px]")
    camera_D: np.ndarray = array("<f8", ("N",), "distortion coefficients in ROS order")
    labels_png: bytes | None = column(
        "logged semantic label image, PNG mono8, labels of the config's label_set"
    )
    detection_boxes_px: np.ndarray | None = array(
        "<f4", ("N", 4), "logged road users: x0 y0 x1 y1 in full-image pixels"
    )
    detection_classes: list[str] | None = column("their classes as logged")
    detection_scores: np.ndarray | None = array("<f4", ("N",), "their scores, 0..1")
    lidar_x_m: np.ndarray = array(
        "<f4", ("N",), "points in the lidar frame, de-skewed to lidar_stamp_ns where lidar_deskewed"
    )
    lidar_y_m: np.ndarray = array("<f4", ("N",), "see lidar_x_m")
    lidar_z_m: np.ndarray = array("<f4", ("N",), "see lidar_x_m")
    lidar_intensity: np.ndarray | None = array("<f4", ("N",), "reflectivity as logged")
    lidar_ring: np.ndarray | None = array("<u2", ("N",), "beam number")
    lidar_time_s: np.ndarray | None = array("<f4", ("N",), "time of each point relative to lidar_stamp_ns")
    lidar_deskewed: bool = column("points were moved to lidar_stamp_ns by the ego motion")
    radar_x_m: np.ndarray = array("<f4", ("N",), "detections in the radar frame")
    radar_y_m: np.ndarray = array("<f4", ("N",), "see radar_x_m")
    radar_z_m: np.ndarray = array("<f4", ("N",), "see radar_x_m; 0 where the radar measures no elevation")
    radar_range_rate_mps: np.ndarray = array(
        "<f4",
        ("N",),
        "Doppler as range rate: positive = receding, whatever the log's sign; not ego-compensated",
    )
    radar_power_db: np.ndarray | None = array("<f4", ("N",), "power or RCS as logged")
    radar_has_elevation: bool = column("False where all elevations are 0")
    doppler_period_mps: float | None = column("range rates are known modulo this; null = unambiguous")
    ego_speed_mps: float | None = column("forward speed from odometry at stamp_ns")
    ego_yaw_rate_radps: float | None = column("yaw rate from odometry, positive to the left")
    ego_qw: float | None = column(_EGO)
    ego_qx: float | None = column(_EGO)
    ego_qy: float | None = column(_EGO)
    ego_qz: float | None = column(_EGO)
    ego_tx_m: float | None = column(_EGO)
    ego_ty_m: float | None = column(_EGO)
    ego_tz_m: float | None = column(_EGO)
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

    @property
    def lidar_xyz_m(self) -> Float32[np.ndarray, "N 3"]:
        """Lidar points [m], lidar frame."""
        return np.stack([self.lidar_x_m, self.lidar_y_m, self.lidar_z_m], axis=-1)

    @property
    def radar_xyz_m(self) -> Float32[np.ndarray, "M 3"]:
        """Radar detections [m], radar frame."""
        return np.stack([self.radar_x_m, self.radar_y_m, self.radar_z_m], axis=-1)


FRAMES = table_of(
    Frame,
    "frames",
    2,
    "One moment per row, in order of stamp. Camera: optical frame; lidar and radar: x forward, y left, z up.",
    made_by="ingest",
    reads_versions=(1,),
)
