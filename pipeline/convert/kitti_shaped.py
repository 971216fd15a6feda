"""Folders in KITTI's layout: View-of-Delft's two trees, or one tree with optional image_3 and radar.

The data sets have no stamps: frames are numbered at 10 Hz from noon of the day given by the caller, and all
sensors of a frame have the same stamp. If poses jump farther than a car drives between frames, a new drive
begins a minute later.

Source: View-of-Delft development kit (vod/configuration/file_locations.py, vod/frame/transformations.py:
pose, calib; radar rows are x, y, z, RCS, v_r, v_r compensated, time); KITTI object development kit.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.convert.recording import Event, Recording, ego_events, read_bytes, read_float_rows
from pipeline.core.errors import ConfigError
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Kind
from pipeline.rig.se3 import inverse

__all__ = ["read_kitti", "read_view_of_delft"]

_PERIOD_NS = 100_000_000
_PAUSE_NS = 60 * 10**9
_JUMP_M = 5.0  # 50 m/s at 10 Hz: a larger step between frames is a new drive
_LIDAR_COLUMNS = ("x", "y", "z", "intensity")
_VOD_RADAR = ("x", "y", "z", "power", "doppler", "", "")  # the last two are derived or constant


@dataclass(frozen=True)
class _Layout:
    """Layout of a folder.

    Args:
        images: folders of images by camera name, files named by frame; P2 in calib is of image_2, P3 of
            image_3.
        radar: folder of .bin; empty = none.
        radar_calib: folder of separate calib files with the radar's transform as Tr_velo_to_cam; empty =
            Tr_radar_to_velo in calib.
        radar_columns: names of a row's columns; columns with empty names are left out.
    """

    images: Mapping[str, str]
    lidar: str
    radar: str
    calib: str
    radar_calib: str
    poses: str
    radar_columns: tuple[str, ...]


def read_view_of_delft(folder: Path, vehicle: str, day: str) -> list[Recording]:
    """Recording of a View-of-Delft folder (`lidar`, `radar`); ConfigError if no frame is complete."""
    lidar, radar = "lidar/training", "radar/training"
    layout = _Layout(
        images={"camera": f"{lidar}/image_2"}, lidar=f"{lidar}/velodyne", radar=f"{radar}/velodyne",
        calib=f"{lidar}/calib", radar_calib=f"{radar}/calib", poses=f"{lidar}/pose", radar_columns=_VOD_RADAR,
    )  # fmt: skip
    return [_read(folder, layout, vehicle, day)]


def read_kitti(folder: Path, vehicle: str, day: str, radar_columns: Sequence[str]) -> list[Recording]:
    """The single recording of a folder with image_2, velodyne and calib, and optional image_3 and radar.

    The radar needs Tr_radar_to_velo. With two cameras, that of image_2 is named left, the other right.

    Raises:
        ConfigError: as `read_view_of_delft`, or the radar's columns lack x, y, z or doppler.
    """
    missing = [name for name in ("x", "y", "z", "doppler") if name not in radar_columns]
    if missing:
        raise ConfigError("command line", "radar-columns", f"lacks {', '.join(missing)}")
    radar = "radar" if (folder / "radar").is_dir() else ""
    pair = {"left": "image_2", "right": "image_3"}
    images = pair if (folder / "image_3").is_dir() else {"camera": "image_2"}
    layout = _Layout(images, "velodyne", radar, "calib", "", "pose", tuple(radar_columns))
    return [_read(folder, layout, vehicle, day)]


def _read(folder: Path, layout: _Layout, vehicle: str, day: str) -> Recording:
    images = {name: _images(folder / held) for name, held in layout.images.items()}
    clouds = {"lidar": layout.lidar} | ({"radar": layout.radar} if layout.radar else {})
    columns = {"lidar": _LIDAR_COLUMNS, "radar": layout.radar_columns}
    common = sorted(set.intersection(*(set(of) for of in images.values())))
    frames = [n for n in common if all((folder / f / f"{n}.bin").is_file() for f in clouds.values())]
    if not frames:
        wanted = [*layout.images.values(), *clouds.values()]
        raise ConfigError(str(folder), "", f"no frame is in all of {', '.join(wanted)}")
    cameras, T_lidar = _calibration(folder, layout, frames[0], {n: of[frames[0]] for n, of in images.items()})
    poses = {n: T for n in frames if (T := _pose(folder / layout.poses / f"{n}.json")) is not None}
    T_odom_base = {n: T @ inverse(T_lidar[next(iter(cameras))]) for n, T in poses.items()}
    stamps = _stamps(frames, T_odom_base, day)
    events = []
    for n, stamp in stamps.items():
        events += [Event(stamp, name, partial(read_bytes, of[n])) for name, of in images.items()]
        events += [
            Event(stamp, name, partial(_points, folder / held / f"{n}.bin", columns[name]))
            for name, held in clouds.items()
        ]
    for drive in _drives(stamps, T_odom_base):
        events += ego_events([stamps[n] for n in drive], [T_odom_base[n] for n in drive])
    events.sort(key=lambda event: event.stamp_ns)
    kinds: dict[str, Kind] = {**dict.fromkeys(cameras, "camera"), "lidar": "lidar"}
    kinds |= {"radar": "radar"} if layout.radar else {}
    return Recording(vehicle, day, folder.resolve().name, kinds, cameras, T_lidar, events)


def _images(folder: Path) -> dict[str, Path]:
    """Images by frame, in order."""
    return {p.stem: p for p in sorted(folder.glob("*")) if p.suffix in (".jpg", ".png")}


def _calibration(
    folder: Path, layout: _Layout, frame: str, images: Mapping[str, Path]
) -> tuple[dict[str, Camera], dict[str, Float[np.ndarray, "4 4"]]]:
    """Cameras by name, and T_lidar_sensor of all sensors: the lidar's pose on the car is unknown."""
    path = folder / layout.calib / f"{frame}.txt"
    lines = _lines(path)
    cameras, T_lidar = {}, {}
    for name, image in images.items():
        P = _matrix(path, lines, f"P{layout.images[name][-1]}")
        cameras[name] = _camera(image, P)
        T_lidar[name] = inverse(_rectified(path, lines, P) @ _matrix(path, lines, "Tr_velo_to_cam"))
    T_lidar["lidar"] = np.eye(4)
    if layout.radar_calib:
        path, first = folder / layout.radar_calib / f"{frame}.txt", next(iter(images))
        own, P = _lines(path), _matrix(path, lines, f"P{layout.images[first][-1]}")
        T_camera_radar = _rectified(path, own, P) @ _matrix(path, own, "Tr_velo_to_cam")
        T_lidar["radar"] = T_lidar[first] @ T_camera_radar
    elif layout.radar:
        T_lidar["radar"] = _matrix(path, lines, "Tr_radar_to_velo")
    return cameras, T_lidar


def _camera(image: Path, P: Float[np.ndarray, "4 4"]) -> Camera:
    """Intrinsics of a rectified camera, and the size of its image."""
    data = np.frombuffer(read_bytes(image), np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if pixels is None:
        raise ConfigError(str(image), "", "is not a readable image")
    return Camera("plumb_bob", P[:3, :3].copy(), np.zeros(5), pixels.shape[1], pixels.shape[0])


def _rectified(path: Path, lines: Mapping[str, Sequence[float]], P: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Transform from the reference camera to the camera of P: rectification and baseline (K^-1 P's last column)."""
    T = np.eye(4)
    T[:3, 3] = np.linalg.solve(P[:3, :3], P[:3, 3])
    R = np.eye(4)
    if len(lines.get("R0_rect", ())) == 9:
        R[:3, :3] = np.reshape(lines["R0_rect"], (3, 3))
    elif "R0_rect" in lines:
        raise ConfigError(str(path), "R0_rect", "needs 9 numbers")
    return T @ R


def _lines(path: Path) -> dict[str, list[float]]:
    found = {}
    for line in read_bytes(path).decode("ascii", "replace").splitlines():
        name, colon, numbers = line.partition(":")
        if colon:
            try:
                found[name.strip()] = [float(word) for word in numbers.split()]
            except ValueError as err:
                raise ConfigError(str(path), name.strip(), f"is not a number: {err}") from err
    return found


def _matrix(path: Path, lines: Mapping[str, Sequence[float]], name: str) -> Float[np.ndarray, "4 4"]:
    values = lines.get(name, ())
    if len(values) != 12:
        raise ConfigError(str(path), name, f"needs 12 numbers and has {len(values)}")
    return np.vstack([np.reshape(values, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _pose(path: Path) -> Float[np.ndarray, "4 4"] | None:
    """T_odom_camera of a pose file. Its key is `odomToCamera`, but the development kit uses it in this direction."""
    if not path.is_file():
        return None
    for line in read_bytes(path).decode("utf-8", "replace").splitlines():
        try:
            held = json.loads(line)
        except ValueError as err:
            raise ConfigError(str(path), "", f"not readable JSON: {err}") from err
        if "odomToCamera" in held:
            T = np.array(held["odomToCamera"], np.float64).reshape(-1)
            if T.size != 16:
                raise ConfigError(str(path), "odomToCamera", f"needs 16 numbers and has {T.size}")
            return T.reshape(4, 4)
    return None


def _stamps(frames: Sequence[str], T_odom_base: Mapping[str, np.ndarray], day: str) -> dict[str, int]:
    """Stamp of each frame at 10 Hz, from its number (else its index), with a pause at each jump."""
    noon = dt.datetime.fromisoformat(f"{day}T12:00:00+00:00")
    start, pauses, found = int(noon.timestamp()) * 10**9, 0, {}
    numbers = [int(n) if n.isdecimal() else k for k, n in enumerate(frames)]
    for k, n in enumerate(frames):
        before, here = T_odom_base.get(frames[k - 1]), T_odom_base.get(n)
        if k and before is not None and here is not None:
            most_m = _JUMP_M * max(numbers[k] - numbers[k - 1], 1)
            pauses += int(np.linalg.norm(here[:3, 3] - before[:3, 3]) > most_m)
        found[n] = start + (numbers[k] - numbers[0]) * _PERIOD_NS + pauses * _PAUSE_NS
    return found


def _drives(stamps: Mapping[str, int], T_odom_base: Mapping[str, np.ndarray]) -> list[list[str]]:
    """Frames with a pose, split at pauses of the stamps."""
    known = [n for n in stamps if n in T_odom_base]
    gaps = np.diff([stamps[n] for n in known])
    return [part.tolist() for part in np.split(np.array(known), np.flatnonzero(gaps >= _PAUSE_NS) + 1)]


def _points(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    rows = read_float_rows(path, len(columns))
    return {name: rows[:, k] for k, name in enumerate(columns) if name}
