"""What is mounted on a vehicle: sensor data sheets, nominal (CAD) poses, and how true poses differ from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse

__all__ = ["RIGS", "CameraSpec", "LidarSpec", "Mounting", "RadarSpec", "RigSpec", "mounting_of", "rig_named"]

# Optical axes (x right, y down, z forward) in a frame with x forward, y left, z up.
_R_BODY_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SENSORS: Final = ("camera", "lidar", "radar")


@dataclass(frozen=True)
class CameraSpec:
    """An f-theta camera: angle from the axis grows linearly with the distance from the centre."""

    width_px: int = 1824
    height_px: int = 940
    horizontal_deg: float = 116.0
    vertical_deg: float = 58.5
    focal_error: float = 0.001  # sd of the true focal length against the logged one
    centre_error_px: float = 0.4  # at full width
    jpeg_quality: int = 88

    def nominal(self) -> Camera:
        """Intrinsics as logged."""
        fx = self.width_px / 2 / np.radians(self.horizontal_deg / 2)
        fy = self.height_px / 2 / np.radians(self.vertical_deg / 2)
        K = np.array([[fx, 0, (self.width_px - 1) / 2], [0, fy, (self.height_px - 1) / 2], [0, 0, 1.0]])
        return Camera("equidistant", K, np.zeros(4), self.width_px, self.height_px)


@dataclass(frozen=True)
class LidarSpec:
    """A scanning lidar; all beams of a column fire together, columns from left to right during `sweep_s`."""

    azimuth_deg: tuple[float, float] = (-30.0, 30.0)
    elevation_deg: tuple[float, float] = (-15.0, 9.0)
    columns: int = 240
    rows: int = 96
    sweep_s: float = 0.08
    min_range_m: float = 5.0
    max_range_m: float = 80.0
    range_sigma_m: float = 0.02
    divergence_deg: float = 0.10  # half angle of the footprint


@dataclass(frozen=True)
class RadarSpec:
    """An FMCW MIMO radar: resolution cells and what the estimator inside it makes of them."""

    azimuth_deg: float = 30.0  # half field of view
    elevation_deg: float = 12.0
    min_range_m: float = 5.0
    max_range_m: float = 80.0
    azimuth_resolution_deg: float = 1.6
    elevation_resolution_deg: float = 6.0
    range_resolution_m: float = 0.3
    doppler_resolution_mps: float = 0.15
    doppler_step_mps: float = 0.08
    doppler_period_mps: float | None = 40.0
    doppler_positive: str = "receding"
    has_elevation: bool = True
    rays: int = 9000


@dataclass(frozen=True)
class RigSpec:
    """Sensors, nominal poses in the vehicle frame (rear axle, on the ground), and clocks."""

    name: str
    camera: CameraSpec = CameraSpec()
    lidar: LidarSpec = LidarSpec()
    radar: RadarSpec = RadarSpec()
    camera_xyz_m: tuple[float, float, float] = (1.62, 0.02, 1.62)
    lidar_xyz_m: tuple[float, float, float] = (1.50, 0.00, 1.80)
    radar_xyz_m: tuple[float, float, float] = (1.66, -0.22, 1.58)
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


RIGS: Final = {
    "paper": RigSpec("paper"),
    # One clock without delays, as the paper's car has it: what methods without time offsets are owed.
    "paper-one-clock": RigSpec("paper-one-clock", camera_delay_s=0.0, radar_delay_s=0.0, delay_sd_s=0.0),
    # No common trigger: every sensor at its own rate and phase, as on most cars.
    "paper-free": RigSpec("paper-free", free_hz=(30.0, 10.0, 13.0)),
    "demo": RigSpec(
        "demo",
        camera=CameraSpec(912, 470),
        lidar=LidarSpec(columns=160, rows=64),
        radar=RadarSpec(rays=6000),
    ),
    "ring16": RigSpec(
        "ring16",
        camera=CameraSpec(912, 470),
        lidar=LidarSpec((-180.0, 180.0), (-15.0, 15.0), 1800, 16, 0.1, 0.8, 100.0),
        radar=RadarSpec(rays=6000, doppler_period_mps=10.394, doppler_positive="approaching"),
    ),
}


def rig_named(name: str) -> RigSpec:
    """One of RIGS; `-flat` behind the name takes the radar's elevation away."""
    base = RIGS[name.removesuffix("-flat")]
    return (
        replace(base, name=name, radar=replace(base.radar, has_elevation=False))
        if name.endswith("-flat")
        else base
    )


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where the sensors of one vehicle are on one day (true), where its log says (nominal), and the true camera."""

    T_vehicle_camera: np.ndarray
    T_vehicle_lidar: np.ndarray
    T_vehicle_radar: np.ndarray
    T_vehicle_nominal_camera: np.ndarray
    T_vehicle_nominal_lidar: np.ndarray
    T_vehicle_nominal_radar: np.ndarray
    camera: Camera
    nominal_camera: Camera
    camera_delay_s: float
    radar_delay_s: float
    radar_range_bias_m: float
    radar_elevation_bias_rad: float
    camera_phase_s: float = 0.0  # of a triggered sensor's stamps after the sweep's, beside jitter
    radar_phase_s: float = 0.0

    def truth(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """T_camera_lidar, T_lidar_radar, T_camera_radar."""
        T_camera_vehicle = inverse(self.T_vehicle_camera)
        return {
            "T_camera_lidar": T_camera_vehicle @ self.T_vehicle_lidar,
            "T_lidar_radar": inverse(self.T_vehicle_lidar) @ self.T_vehicle_radar,
            "T_camera_radar": T_camera_vehicle @ self.T_vehicle_radar,
        }


def _nominal(rig: RigSpec) -> dict[str, np.ndarray]:
    return {
        "camera": from_rotation_translation(_R_BODY_OPTICAL, np.array(rig.camera_xyz_m)),
        "lidar": from_rotation_translation(np.eye(3), np.array(rig.lidar_xyz_m)),
        "radar": from_rotation_translation(np.eye(3), np.array(rig.radar_xyz_m)),
    }


def _disturbed(T: np.ndarray, rotation_rad: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
    """Turned about the vehicle's axes at the sensor's own place, and shifted along them."""
    return from_rotation_translation(exp_so3(rotation_rad) @ T[:3, :3], T[:3, 3] + translation_m)


def mounting_of(rig: RigSpec, seed: int, vehicle: int, day: int) -> Mounting:
    """Mounting of a vehicle on a day: CAD, then how this vehicle was built, then how the day's remount left it."""
    built = np.random.default_rng([seed, vehicle, 41])
    remount = np.random.default_rng([seed, vehicle, day, 42])
    nominal, true = _nominal(rig), {}
    for sensor in SENSORS:
        axis = built.normal(size=3)
        angle = (
            np.radians(rig.prior_rotation_deg) * np.clip(abs(built.normal(1.0, 0.3)), 0.3, 1.7) / np.sqrt(2)
        )
        T = _disturbed(
            nominal[sensor], angle * axis / np.linalg.norm(axis), built.normal(0, rig.prior_translation_m, 3)
        )
        rotation = np.radians(rig.remount_rotation_deg) * remount.normal(size=3)
        true[sensor] = _disturbed(T, rotation, rig.remount_translation_m * remount.normal(size=3))
    logged = rig.camera.nominal()
    K = logged.K.copy()
    K[0, 0] *= 1 + built.normal(0, rig.camera.focal_error)
    K[1, 1] *= K[0, 0] / logged.K[0, 0]
    K[:2, 2] += built.normal(0, rig.camera.centre_error_px * rig.camera.width_px / 1824, 2)
    return Mounting(
        true["camera"],
        true["lidar"],
        true["radar"],
        nominal["camera"],
        nominal["lidar"],
        nominal["radar"],
        Camera(logged.model, K, logged.D, logged.width_px, logged.height_px),
        logged,
        rig.camera_delay_s + built.normal(0, rig.delay_sd_s),
        rig.radar_delay_s + built.normal(0, rig.delay_sd_s),
        built.normal(0, 0.03),
        np.radians(built.normal(0, 0.15)),
    )
