"""What a rig is: the data sheets of its sensors, where the drawings put them, and how far cars differ from that."""

from __future__ import annotations

from dataclasses import dataclass, field

from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec

__all__ = ["RigSpec"]


@dataclass(frozen=True)
class RigSpec:
    """Sensors, nominal poses in the vehicle frame (rear axle, on the ground), and clocks."""

    name: str
    camera: CameraSpec = field(default_factory=CameraSpec)
    lidar: LidarSpec = field(default_factory=LidarSpec)
    radar: RadarSpec = field(default_factory=RadarSpec)
    camera_xyz_m: tuple[float, float, float] = (1.62, 0.02, 1.62)
    lidar_xyz_m: tuple[float, float, float] = (1.50, 0.00, 1.80)
    radar_xyz_m: tuple[float, float, float] = (1.66, -0.22, 1.58)
    # Turned about the vehicle's axes: roll first, then pitch (positive = nose down), then yaw (to the left).
    camera_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lidar_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radar_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_delay_s: float = 0.012  # stamp of an event on the camera less its stamp on the lidar
    radar_delay_s: float = -0.018
    delay_sd_s: float = 0.004  # sd per vehicle of both delays
    sync_jitter_s: float = 0.0012
    # Rates [Hz] of camera, lidar and radar that run freely; None = the lidar triggers both.
    free_hz: tuple[float, float, float] | None = None
    prior_rotation_deg: float = 1.2  # sd per vehicle and sensor of the mounting against CAD, angle
    prior_translation_m: float = 0.02  # sd per axis
    remount_rotation_deg: float = 0.02  # sd per day and axis
    remount_translation_m: float = 0.002
