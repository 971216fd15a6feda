"""Folders in nuScenes' layout: a recording per scene, with samples and sweeps of all sensors.

nuScenes' lidar looks along y, with x to the right: its points are rotated to x forward, y left. Its radar
gives a velocity vector; the component along the ray is the measured one. Points that the devkit hides by
default (ambiguous, invalid) are left out. Sweeps have no times of points and are not de-skewed.

Source: nuscenes-devkit, docs/schema_nuscenes.md and utils/data_classes.py (RadarPointCloud, LidarPointCloud).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.convert.recording import (
    Event,
    Recording,
    ego_events,
    read_bytes,
    read_float_rows,
    read_json,
    read_pcd,
)
from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind
from pipeline.rig.se3 import from_quaternion, from_rotation_translation

__all__ = ["read_nuscenes"]

# Rotation from x forward, y left, z up to nuScenes' lidar frame (x right, y forward, z up).
_T_NUSCENES_LIDAR = from_rotation_translation(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
_OfScene = defaultdict[str, defaultdict[str, list[dict[str, Any]]]]
_UNAMBIGUOUS, _VALID = 3, 0  # ambig_state and invalid_state that the devkit shows by default


def read_nuscenes(folder: Path, channels: Mapping[Kind, Sequence[str]]) -> list[Recording]:
    """Recordings of all scenes; points are loaded later.

    Sensors are named after their channels in lower case, such as cam_front; if no kind has two, after their
    kinds.

    Args:
        channels: channels to use, by kind; all channels of a kind that is not given.

    Raises:
        ConfigError: a table, row or channel is missing; the message names the file.
    """
    tables = _Tables(folder)
    calibrated, poses, logs = (tables.by_token(name) for name in ("calibrated_sensor", "ego_pose", "log"))
    sensors = _sensors(tables, channels)
    of_scene = _by_scene(tables, {token: name for token, (name, _) in sensors.items()}, calibrated)
    kinds = dict(sensors.values())
    recordings = []
    for scene in tables.rows("scene"):
        rows = of_scene[scene["token"]]
        there = {name: kind for name, kind in kinds.items() if rows[name]}
        if len(there) > 1:
            log = logs[scene["log_token"]]
            about = (str(log["vehicle"]), str(log["date_captured"]), str(scene["name"]))
            recordings.append(_recording(folder, about, there, rows, calibrated, poses))
    if not recordings:
        raise ConfigError(str(tables.path("scene")), "", "no scene has two sensors")
    return recordings


def _sensors(tables: _Tables, channels: Mapping[Kind, Sequence[str]]) -> dict[str, tuple[str, Kind]]:
    """Name and kind of the sensors to use, cameras first, by their tokens."""
    rows = {str(row["channel"]): row for row in tables.rows("sensor")}
    for kind, channel in ((kind, c) for kind, of in channels.items() for c in of):
        there = sorted(c for c, row in rows.items() if row["modality"] == kind)
        if channel not in there:
            words = f"no such {kind}; there are {', '.join(there) or 'none'}"
            raise ConfigError(str(tables.path("sensor")), channel, words)
    kinds: tuple[Kind, ...] = ("camera", "lidar", "radar")
    taken = {k: [c for c in channels.get(k, rows) if rows[c]["modality"] == k] for k in kinds}
    is_short = all(len(of) <= 1 for of in taken.values())
    return {str(rows[c]["token"]): (k if is_short else c.lower(), k) for k, of in taken.items() for c in of}


def _by_scene(tables: _Tables, name_of: Mapping[str, str], calibrated: Mapping[str, Any]) -> _OfScene:
    """Rows of sample_data by scene and sensor name."""
    samples = tables.by_token("sample")
    of_scene: _OfScene = defaultdict(lambda: defaultdict(list))
    for row in tables.rows("sample_data"):
        name = name_of.get(calibrated[row["calibrated_sensor_token"]]["sensor_token"])
        if name is not None:
            of_scene[samples[row["sample_token"]]["scene_token"]][name].append(row)
    return of_scene


class _Tables:
    """Tables of the single folder of tables, read on demand."""

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
            raise ConfigError(str(self.path(table)), "", "is not a list of rows")
        return [_Row(str(self.path(table)), row) for row in rows]

    def by_token(self, table: str) -> dict[str, Any]:
        return _Row(str(self.path(table)), {row["token"]: row for row in self.rows(table)})


class _Row(dict[str, Any]):
    """A row, or rows by token, whose error for a missing key names the table."""

    def __init__(self, file: str, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self._file = file

    def __missing__(self, key: str) -> Any:
        raise ConfigError(self._file, key, "missing")


def _recording(
    folder: Path,
    about: tuple[str, str, str],
    kinds: Mapping[str, Kind],
    rows: Mapping[str, list[dict[str, Any]]],
    calibrated: Mapping[str, dict[str, Any]],
    poses: Mapping[str, dict[str, Any]],
) -> Recording:
    first = {name: calibrated[rows[name][0]["calibrated_sensor_token"]] for name in kinds}
    T_base = {
        n: _pose(row) @ (_T_NUSCENES_LIDAR if kinds[n] == "lidar" else np.eye(4)) for n, row in first.items()
    }
    cameras = {
        name: _camera(folder, first[name], rows[name][0]) for name, kind in kinds.items() if kind == "camera"
    }
    loaders = {"camera": read_bytes, "lidar": _lidar, "radar": _radar}
    events = [
        Event(_stamp_ns(row), name, partial(loaders[kind], folder / row["filename"]))
        for name, kind in kinds.items()
        for row in rows[name]
    ]
    # Every row has the pose of its own time; the lidar's rows are the most frequent.
    ego = next((n for n, kind in kinds.items() if kind == "lidar"), next(iter(kinds)))
    events += _ego(rows[ego], poses)
    return Recording(*about, kinds, cameras, T_base, sorted(events, key=lambda event: event.stamp_ns))


def _camera(folder: Path, calibrated: Mapping[str, Any], image: Mapping[str, Any]) -> Camera:
    K = np.array(calibrated["camera_intrinsic"], np.float64)
    if K.shape != (3, 3):
        raise ConfigError(str(folder), "calibrated_sensor.camera_intrinsic", "is not a 3x3 matrix")
    return Camera("plumb_bob", K, np.zeros(5), int(image["width"]), int(image["height"]))


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
    """x, y, z, intensity, ring; in the file x points to the right and y forward."""
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
