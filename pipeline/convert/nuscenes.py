"""nuScenes-shaped folders: a recording per scene, samples and sweeps of a camera, the lidar and a radar.

nuScenes' lidar looks along y, with x to the right: its points are turned to x forward, y left. Its radar gives a
velocity vector, whose part along the ray is what was measured; points that the devkit hides by default (ambiguous,
invalid) are left out. Sweeps have no times of points and are not de-skewed.

Source: nuscenes-devkit, docs/schema_nuscenes.md and utils/data_classes.py (RadarPointCloud, LidarPointCloud).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.convert.files import read_bytes, read_float_rows, read_json, read_pcd
from pipeline.convert.recording import Event, Recording, ego_events
from pipeline.errors import ConfigError
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import from_quaternion, from_rotation_translation

__all__ = ["Channels", "read_nuscenes"]

# Coordinates in x forward, y left, z up to those of nuScenes' lidar (x right, y forward, z up).
_T_NUSCENES_LIDAR = from_rotation_translation(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
_KINDS = {"camera": "image", "lidar": "lidar", "radar": "radar"}
_OfScene = defaultdict[str, defaultdict[str, list[dict[str, Any]]]]
_UNAMBIGUOUS, _VALID = 3, 0  # ambig_state and invalid_state that the devkit shows by default


@dataclass(frozen=True)
class Channels:
    """Which sensors make the trio."""

    camera: str = "CAM_FRONT"
    lidar: str = "LIDAR_TOP"
    radar: str = "RADAR_FRONT"


def read_nuscenes(folder: Path, channels: Channels) -> list[Recording]:
    """Recordings of all scenes, their points not loaded yet.

    Args:
        folder: holds one folder of tables (as v1.0-mini), samples and sweeps.
        channels: which sensors make the trio.

    Raises:
        ConfigError: a table, row or channel is missing; it names the file.
    """
    tables = _Tables(folder)
    calibrated = {row["token"]: row for row in tables.rows("calibrated_sensor")}
    of_scene = _by_scene(tables, channels, calibrated)
    poses = {row["token"]: row for row in tables.rows("ego_pose")}
    logs = {row["token"]: row for row in tables.rows("log")}
    recordings = []
    for scene in tables.rows("scene"):
        rows = of_scene[scene["token"]]
        if all(rows[role] for role in _KINDS):
            log = tables.found("log", logs, scene["log_token"])
            about = (str(log["vehicle"]), str(log["date_captured"]), str(scene["name"]))
            recordings.append(_recording(folder, about, rows, calibrated, poses))
    if not recordings:
        raise ConfigError(str(tables.path("scene")), "", "no scene has all three sensors")
    return recordings


def _by_scene(tables: _Tables, channels: Channels, calibrated: Mapping[str, Any]) -> _OfScene:
    """Rows of sample_data by scene and role, of the trio's channels."""
    sensors = {row["channel"]: row["token"] for row in tables.rows("sensor")}
    role_of = {}
    for role, channel in vars(channels).items():
        if channel not in sensors:
            there = ", ".join(sorted(sensors))
            raise ConfigError(str(tables.path("sensor")), channel, f"no such channel; there are {there}")
        role_of[sensors[channel]] = role
    scene_of = {row["token"]: row["scene_token"] for row in tables.rows("sample")}
    of_scene: _OfScene = defaultdict(lambda: defaultdict(list))
    for row in tables.rows("sample_data"):
        sensor = tables.found("calibrated_sensor", calibrated, row["calibrated_sensor_token"])["sensor_token"]
        if sensor in role_of:
            of_scene[tables.found("sample", scene_of, row["sample_token"])][role_of[sensor]].append(row)
    return of_scene


class _Tables:
    """Tables of the only folder that has them, read as they are asked for."""

    def __init__(self, folder: Path) -> None:
        found = sorted(p.parent for p in folder.glob("*/calibrated_sensor.json"))
        if len(found) != 1:
            names = ", ".join(p.name for p in found) or "none"
            raise ConfigError(str(folder), "", f"needs one folder of tables, as v1.0-mini, and has {names}")
        self._folder = found[0]

    def path(self, table: str) -> Path:
        return self._folder / f"{table}.json"

    def rows(self, table: str) -> list[dict[str, Any]]:
        rows = read_json(self.path(table))
        if not isinstance(rows, list):
            raise ConfigError(str(self.path(table)), "", "is no list of rows")
        return [_Row(str(self.path(table)), row) for row in rows]

    def found(self, table: str, rows: Mapping[str, Any], token: str) -> Any:
        if token not in rows:
            raise ConfigError(str(self.path(table)), token, "no such row")
        return rows[token]


class _Row(dict[str, Any]):
    """A row that names its table where it lacks a field."""

    def __init__(self, file: str, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self._file = file

    def __missing__(self, key: str) -> Any:
        raise ConfigError(self._file, key, "missing")


def _recording(
    folder: Path,
    about: tuple[str, str, str],
    rows: Mapping[str, list[dict[str, Any]]],
    calibrated: Mapping[str, dict[str, Any]],
    poses: Mapping[str, dict[str, Any]],
) -> Recording:
    first = {role: calibrated[rows[role][0]["calibrated_sensor_token"]] for role in _KINDS}
    T_base = {role: _pose(row) for role, row in first.items()}
    T_base["lidar"] = T_base["lidar"] @ _T_NUSCENES_LIDAR
    K = np.array(first["camera"]["camera_intrinsic"], np.float64)
    if K.shape != (3, 3):
        raise ConfigError(str(folder), "calibrated_sensor.camera_intrinsic", "is no 3x3 matrix")
    image = rows["camera"][0]
    camera = Camera("plumb_bob", K, np.zeros(5), int(image["width"]), int(image["height"]))
    loaders = {"camera": read_bytes, "lidar": _lidar, "radar": _radar}
    events = [
        Event(_stamp_ns(row), kind, partial(loaders[role], folder / row["filename"]))
        for role, kind in _KINDS.items()
        for row in rows[role]
    ]
    events += _ego(rows["lidar"], poses)
    return Recording(*about, camera, T_base, sorted(events, key=lambda event: event.stamp_ns))


def _stamp_ns(row: Mapping[str, Any]) -> int:
    return int(row["timestamp"]) * 1000  # microseconds


def _ego(rows: Iterable[Mapping[str, Any]], poses: Mapping[str, dict[str, Any]]) -> list[Event]:
    known = {
        _stamp_ns(row): _pose(poses[row["ego_pose_token"]]) for row in rows if row["ego_pose_token"] in poses
    }
    stamps = sorted(known)
    return ego_events(stamps, [known[stamp] for stamp in stamps])


def _pose(row: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    q, t = np.array(row["rotation"], np.float64), np.array(row["translation"], np.float64)
    return from_quaternion(q, t)


def _lidar(path: Path) -> dict[str, np.ndarray]:
    """x, y, z, intensity, ring; the file's x points to the right and its y forward."""
    points = read_float_rows(path, 5)
    return {
        "x": points[:, 1],
        "y": -points[:, 0],
        "z": points[:, 2],
        "intensity": points[:, 3],
        "ring": points[:, 4].astype(np.uint16),
    }


def _radar(path: Path) -> dict[str, np.ndarray]:
    """x, y, z, power and the range rate, positive = receding."""
    points = read_pcd(path)
    keep = (points["invalid_state"] == _VALID) & (points["ambig_state"] == _UNAMBIGUOUS)
    x, y, vx, vy = (points[name][keep].astype(np.float64) for name in ("x", "y", "vx", "vy"))
    rate = (x * vx + y * vy) / np.maximum(np.hypot(x, y), 1e-6)
    columns = {"x": x, "y": y, "z": points["z"][keep], "doppler": rate, "power": points["rcs"][keep]}
    return {name: values.astype(np.float32) for name, values in columns.items()}
