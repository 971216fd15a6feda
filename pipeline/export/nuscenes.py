"""nuScenes' tables sensor and calibrated_sensor, and TIER IV's T4, which includes the camera's distortion.

`calibrated_sensor` holds T_ego_sensor: rotation (w, x, y, z), translation [m]; the ego frame is the root of
the tree.

Source: nuscenes-devkit, docs/schema_nuscenes.md; tier4/t4-devkit, schema.
"""

from __future__ import annotations

import hashlib
from functools import partial
from typing import Any

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, needed_camera
from pipeline.export.formats import Files, Format
from pipeline.export.texts import field_of, load_json, number_of, pose_of_quaternion, to_json
from pipeline.rig.se3 import to_quaternion
from pipeline.rig.transform_tree import TransformTree

__all__ = ["NUSCENES", "T4"]

_EGO = "nuscenes ego"  # no channel has this name
_SAME = 1e-9  # tolerance: poses of one channel in scenes of one car are the same numbers
_NOTES = (
    "The ego frame is the root listed under `frames`: the lidar, if its pose on the car is unknown.",
    "nuScenes' images are rectified: undistort the camera's images before use with camera_intrinsic.",
)


def _write(calibration: ExportedCalibration, *, distortion: bool) -> dict[str, bytes]:
    sensors, calibrated = [], []
    for own in calibration.sensors:
        T = calibration.T_root(own.name)
        if T is None:
            continue
        channel = calibration.names.of(own.name)
        sensor = {"token": _token("sensor", channel), "channel": channel, "modality": own.kind}
        camera = needed_camera(calibration, "nuscenes", own.name) if own.kind == "camera" else None
        row: dict[str, Any] = {
            "token": _token("calibrated_sensor", calibration.vehicle, calibration.source, channel),
            "sensor_token": sensor["token"],
            "translation": [float(v) + 0.0 for v in T[:3, 3]],
            "rotation": [float(v) + 0.0 for v in to_quaternion(T)],
            "camera_intrinsic": [] if camera is None else camera.K,
        }
        if distortion:
            row["camera_distortion"] = [] if camera is None else camera.D
        sensors.append(sensor)
        calibrated.append(row)
    return {"sensor.json": to_json(sensors), "calibrated_sensor.json": to_json(calibrated)}


def _token(*words: str) -> str:
    """32 hexadecimal digits, equal for equal words."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:32]


def _tree(files: Files) -> TransformTree:
    tables = {file.rpartition("/")[2]: (file, load_json(file, content)) for file, content in files.items()}
    for name in ("sensor.json", "calibrated_sensor.json"):
        if name not in tables:
            raise ConfigError(", ".join(files), name, "missing: give sensor.json and calibrated_sensor.json")
        if not isinstance(tables[name][1], list):
            raise ConfigError(tables[name][0], "", "is not a list of rows")
    file, rows = tables["sensor.json"]
    channels = {
        field_of(file, rows, k, "token"): field_of(file, rows, k, "channel") for k in range(len(rows))
    }
    file, rows = tables["calibrated_sensor.json"]
    tree = TransformTree()
    for k in range(len(rows)):
        channel = channels.get(field_of(file, rows, k, "sensor_token"))
        if channel is None:
            raise ConfigError(file, f"{k}.sensor_token", "is not in sensor.json")
        q = [number_of(file, rows, k, "rotation", i) for i in range(4)]
        t = [number_of(file, rows, k, "translation", i) for i in range(3)]
        T = pose_of_quaternion(file, f"{k}.rotation", q, t)
        known = tree.lookup(_EGO, channel)
        if known is not None and np.abs(known - T).max() > _SAME:
            problem = "its rows disagree: several cars or days; give the rows of one"
            raise ConfigError(file, f"{channel}", problem)
        tree.add_transform(_EGO, channel, T)
    return tree


NUSCENES = Format("nuscenes", partial(_write, distortion=False), tree=_tree, notes=_NOTES)
T4 = Format("t4", partial(_write, distortion=True), tree=_tree, notes=_NOTES[:1])
