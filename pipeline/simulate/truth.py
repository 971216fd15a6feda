"""True poses, clocks and errors of a vehicle-day, by sensor, for evaluation; not in the logs."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from pipeline.simulate.faults import DayFaults, misread
from pipeline.simulate.sensors.data_sheets import CameraSpec
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec

__all__ = ["truth_of"]


def truth_of(rig: RigSpec, morning: Mounting, evening: Mounting, today: DayFaults) -> dict[str, Any]:
    """Poses, clocks and errors of a day's sensors; stamp_a = stamp_b + dt_a_b_s, as in records."""
    ends = _poses(evening) | (evening.pairs() if rig.is_short else {})
    return {
        "rig": rig.name,
        "reference": rig.reference.name,
        **_poses(morning),
        "cameras": {s.name: _camera(s, morning, today) for s in rig.of_kind("camera")},
        "radars": {n: asdict(m.errors) for n, m in morning.sensors.items() if m.errors is not None},
        **(_of_three(morning, rig, today) if rig.is_short else {}),
        "at_end_of_day": ends,
    }


def _poses(mounting: Mounting) -> dict[str, Any]:
    """Poses of all sensors, and delays of their stamps relative to the reference's."""
    sensors = mounting.sensors.items()
    return {
        "T_base_sensor": {n: m.T_vehicle.tolist() for n, m in sensors},
        "dt_s": {n: m.delay_s for n, m in sensors},
    }


def _camera(sensor: SensorSpec, mounting: Mounting, today: DayFaults) -> dict[str, Any]:
    assert isinstance(sensor.sheet, CameraSpec)
    true, logged = mounting.camera(sensor.name)
    stated = misread(logged, today, sensor.name)
    return {"K": true.K.tolist(), "K_logged": stated.K.tolist(), "readout_s": sensor.sheet.readout_s}


def _of_three(m: Mounting, rig: RigSpec, today: DayFaults) -> dict[str, Any]:
    """Truth of a three-sensor rig under the keys that its readers expect."""
    camera, radar, errors = m["camera"], m["radar"], m["radar"].errors
    assert errors is not None
    about = _camera(rig["camera"], m, today)
    return {
        **m.pairs(),
        **{f"T_vehicle_{n}": mounted.T_vehicle.tolist() for n, mounted in m.sensors.items()},
        "dt_camera_lidar_s": camera.delay_s,
        "dt_lidar_radar_s": -radar.delay_s,
        "dt_camera_radar_s": camera.delay_s - radar.delay_s,
        "radar_range_bias_m": errors.range_bias_m,
        "radar_elevation_bias_rad": errors.elevation_bias_rad,
        "camera_K": about["K"],
        "camera_K_logged": about["K_logged"],
        "camera_readout_s": about["readout_s"],
    }
