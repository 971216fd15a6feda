"""True and logged mounting of a vehicle's sensors on one day."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.simulate.sensors.radar import RadarErrors
from pipeline.simulate.sensors.rig_spec import CameraSpec, RigSpec, SensorSpec, Triple

__all__ = ["Mounted", "Mounting", "disturbed", "mounting_of"]

# Optical axes (x right, y down, z forward) in a frame with x forward, y left, z up.
_R_BODY_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Mounted:
    """One sensor of one vehicle on one day.

    Args:
        T_vehicle: true pose, T_vehicle_sensor.
        T_vehicle_nominal: pose in /tf_static.
        delay_s: its stamp of an event minus the reference lidar's.
        phase_s: constant offset of its stamps after the moment, without jitter.
        camera: true intrinsics of a camera.
        errors: of a radar.
    """

    T_vehicle: np.ndarray
    T_vehicle_nominal: np.ndarray
    delay_s: float = 0.0
    phase_s: float = 0.0
    camera: Camera | None = None
    errors: RadarErrors = field(default_factory=RadarErrors)


@dataclass(frozen=True, eq=False)
class Mounting:
    """All sensors of one vehicle on one day, by name."""

    sensors: Mapping[str, Mounted]

    def __getitem__(self, name: str) -> Mounted:
        """The sensor of that name."""
        return self.sensors[name]

    def nominal(self) -> dict[str, np.ndarray]:
        """T_vehicle_sensor as in /tf_static."""
        return {name: mounted.T_vehicle_nominal for name, mounted in self.sensors.items()}

    def between(self, parent: str, child: str) -> Float[np.ndarray, "4 4"]:
        """True T_parent_child of two sensors."""
        return inverse(self[parent].T_vehicle) @ self[child].T_vehicle

    def pairs(self) -> dict[str, list[list[float]]]:
        """True T_parent_child of the pairs of a three-sensor rig."""
        pairs = (("camera", "lidar"), ("lidar", "radar"), ("camera", "radar"))
        return {f"T_{a}_{b}": self.between(a, b).tolist() for a, b in pairs}

    def camera(self, name: str) -> Camera:
        """True intrinsics of a camera."""
        camera = self[name].camera
        assert camera is not None, f"{name} is a camera"
        return camera


def mounting_of(rig: RigSpec, seed: int, vehicle: int, day: int) -> Mounting:
    """Mounting of a vehicle on a day: CAD plus deviations of this vehicle and of the day's remount."""
    built = np.random.default_rng([seed, vehicle, 41])
    remount = np.random.default_rng([seed, vehicle, day, 42])
    poses = {s.name: _poses(rig, s, built, remount) for s in rig.sensors}
    cameras = {s.name: _camera(s.sheet, built) for s in rig.sensors if isinstance(s.sheet, CameraSpec)}
    delays = {s.name: s.delay_s + built.normal(0, rig.delay_sd_s) for s in rig.sensors if s != rig.reference}
    # Range bias [m], elevation bias [deg].
    errors = {
        s.name: RadarErrors(built.normal(0, 0.03), np.radians(built.normal(0, 0.15)))
        for s in rig.of_kind("radar")
    }
    return Mounting(
        {
            n: Mounted(*pose, delays.get(n, 0.0), camera=cameras.get(n), errors=errors.get(n, RadarErrors()))
            for n, pose in poses.items()
        }
    )


def _poses(
    rig: RigSpec, sensor: SensorSpec, built: np.random.Generator, remount: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """True and nominal T_vehicle_sensor."""
    R = _turned(sensor.rpy_deg) @ (_R_BODY_OPTICAL if sensor.kind == "camera" else np.eye(3))
    nominal = from_rotation_translation(R, np.array(sensor.xyz_m))
    axis = built.normal(size=3)
    angle = np.radians(rig.prior_rotation_deg) * np.clip(abs(built.normal(1.0, 0.3)), 0.3, 1.7) / np.sqrt(2)
    shift = built.normal(0, rig.prior_translation_m, 3)
    T = disturbed(nominal, angle * axis / np.linalg.norm(axis), shift)
    rotation = np.radians(rig.remount_rotation_deg) * remount.normal(size=3)
    return disturbed(T, rotation, rig.remount_translation_m * remount.normal(size=3)), nominal


def _camera(sheet: CameraSpec, built: np.random.Generator) -> Camera:
    """True intrinsics."""
    logged = sheet.nominal()
    K = logged.K.copy()
    K[0, 0] *= 1 + built.normal(0, sheet.focal_error)
    K[1, 1] *= K[0, 0] / logged.K[0, 0]
    K[:2, 2] += built.normal(0, sheet.centre_error_px * sheet.width_px / 1824, 2)
    return replace(logged, K=K)


def _turned(rpy_deg: Triple) -> np.ndarray:
    R = np.eye(3)
    for axis, angle in zip(np.eye(3), np.radians(rpy_deg), strict=True):
        R = exp_so3(angle * axis) @ R
    return R


def disturbed(T: np.ndarray, rotation_rad: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
    """Rotated about the vehicle's axes at the sensor's position, and shifted along them."""
    return from_rotation_translation(exp_so3(rotation_rad) @ T[:3, :3], T[:3, 3] + translation_m)
