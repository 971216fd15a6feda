"""What is mounted on a vehicle: rigs of sensors, nominal (CAD) poses, and how true poses differ from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec
from pipeline.simulate.sensors.random_rigs import random_rig
from pipeline.simulate.sensors.rig_spec import RigSpec

__all__ = ["RIGS", "Mounting", "RigSpec", "mounting_of", "rig_named"]

# Optical axes (x right, y down, z forward) in a frame with x forward, y left, z up.
_R_BODY_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SENSORS: Final = ("camera", "lidar", "radar")
RANDOM: Final = "random-"  # begins the names of rigs that a seed draws


# Half the pixels of the paper's camera, and a lidar and a radar to match: as good for most purposes, and much faster.
_CAMERA, _LIDAR, _RADAR = CameraSpec(912, 470), LidarSpec(columns=160, rows=64), RadarSpec(rays=6000)
# All around, as on a roof: 0.4 deg by 1.3 deg.
_SPINNING: Final = LidarSpec((-180.0, 180.0), (-25.0, 15.0), 900, 32, 0.1, 0.8, 100.0)
# Steps of data sheets with 128 channels: 0.125 deg around the horizon, 0.5 deg above and below, 1 deg at the ends.
_ROWS_128: Final = (
    *np.arange(-25.0, -14.0, 1.0).tolist(),
    *np.arange(-14.0, -7.0, 0.5).tolist(),
    *np.arange(-7.0, 3.0, 0.125).tolist(),
    *np.arange(3.0, 13.0, 0.5).tolist(),
    *np.arange(13.0, 15.5, 1.0).tolist(),
)
_CORNER: Final = RadarSpec(azimuth_deg=60.0, azimuth_resolution_deg=3.2, rays=9000)
_BASE: Final = RigSpec("demo", camera=_CAMERA, lidar=_LIDAR, radar=_RADAR)

_ALL: Final = (
    RigSpec("paper"),
    # One clock without delays, as the paper's car has it: what methods without time offsets are owed.
    RigSpec("paper-one-clock", camera_delay_s=0.0, radar_delay_s=0.0, delay_sd_s=0.0),
    # No common trigger: every sensor at its own rate and phase, as on most cars.
    RigSpec("paper-free", free_hz=(30.0, 10.0, 13.0)),
    _BASE,
    RigSpec(
        "ring16",
        camera=_CAMERA,
        lidar=LidarSpec((-180.0, 180.0), (-15.0, 15.0), 1800, 16, 0.1, 0.8, 100.0),
        radar=RadarSpec(rays=6000, doppler_period_mps=10.394, doppler_positive="approaching"),
    ),
    # Radars of the bumper's corners look past what a forward lidar sees.
    replace(
        _BASE, name="corner-left", lidar=_SPINNING, radar=_CORNER,
        radar_xyz_m=(3.60, 0.80, 0.60), radar_rpy_deg=(0.0, 0.0, 45.0),
    ),
    replace(
        _BASE, name="corner-right", lidar=_SPINNING, radar=_CORNER,
        radar_xyz_m=(3.60, -0.80, 0.60), radar_rpy_deg=(0.0, 0.0, -45.0),
    ),
    replace(
        _BASE, name="spin128",
        lidar=LidarSpec(
            (-180.0, 180.0), (-25.0, 15.0), 1200, 128, 0.1, 0.8, 120.0, row_elevation_deg=_ROWS_128
        ),
    ),
    # 240,000 beams a second over 82 x 25 deg, as Livox' Horizon has them; six lasers behind the same prisms.
    replace(
        _BASE, name="rosette",
        lidar=LidarSpec((-41.0, 41.0), (-14.5, 10.5), 4000, 6, 0.1, 1.0, 100.0, pattern="rosette"),
    ),
    replace(_BASE, name="fisheye", camera=CameraSpec(1280, 960, 190.0, 142.5), lidar=_SPINNING),
    replace(
        _BASE, name="pinhole",
        camera=CameraSpec(
            1280, 720, 72.0, 44.5, model="plumb_bob", distortion=(-0.32, 0.11, 5e-4, -4e-4, -0.015)
        ),
    ),
    replace(_BASE, name="rolling", camera=replace(_CAMERA, readout_s=0.03)),
    # A cab: everything high up but the radar, and looking down.
    replace(
        _BASE, name="truck", lidar=replace(_LIDAR, elevation_deg=(-21.0, 3.0)),
        camera_xyz_m=(2.10, 0.10, 2.55), camera_rpy_deg=(0.0, 6.0, 0.0), lidar_xyz_m=(1.90, 0.0, 3.00),
        radar_xyz_m=(2.60, -0.15, 0.65),
    ),
    replace(_BASE, name="bumper", radar_xyz_m=(3.70, 0.05, 0.50)),
    # Nose down, and twice as fast.
    replace(_BASE, name="tilted", lidar=replace(_LIDAR, sweep_s=0.04), lidar_rpy_deg=(0.0, 5.0, 0.0)),
)  # fmt: skip
RIGS: Final = {rig.name: rig for rig in _ALL}


def rig_named(name: str) -> RigSpec:
    """One of RIGS, or `random-SEED`; `-flat` behind the name takes the radar's elevation away.

    Raises:
        ConfigError: no such rig.
    """
    plain = name.removesuffix("-flat")
    seed = plain.removeprefix(RANDOM)
    base = random_rig(int(seed)) if plain != seed and seed.isdecimal() else RIGS.get(plain)
    if base is None:
        known = f"{', '.join(RIGS)}, {RANDOM}SEED, each with or without -flat"
        raise ConfigError("simulate", "rig", f"{name!r} is not one of {known}")
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
        "camera": from_rotation_translation(
            _turned(rig.camera_rpy_deg) @ _R_BODY_OPTICAL, np.array(rig.camera_xyz_m)
        ),
        "lidar": from_rotation_translation(_turned(rig.lidar_rpy_deg), np.array(rig.lidar_xyz_m)),
        "radar": from_rotation_translation(_turned(rig.radar_rpy_deg), np.array(rig.radar_xyz_m)),
    }


def _turned(rpy_deg: tuple[float, float, float]) -> np.ndarray:
    R = np.eye(3)
    for axis, angle in zip(np.eye(3), np.radians(rpy_deg), strict=True):
        R = exp_so3(angle * axis) @ R
    return R


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
