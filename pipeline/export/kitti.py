"""KITTI's calibration of one frame (object benchmark), a file per camera, with V2X-Radar's line for a radar.

Row-major numbers after a name: P0 to P3 (3x4), R0_rect (3x3), Tr_velo_to_cam, Tr_imu_to_velo,
Tr_radar_to_velo (3x4). Tr_a_to_b maps coordinates from a to b. Tr_velo_to_cam = T_camera_lidar if image_2's
camera is the reference; in KITTI's own files the reference is another camera, and reading corrects for that.

Source: KITTI object development kit, readme and matlab/; V2X-Radar (Tr_radar_to_velo).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames, cameras_of, needed_camera
from pipeline.export.formats import Files, Format
from pipeline.export.texts import matrix_of, text_of
from pipeline.rig.graph import Edge, words_of
from pipeline.rig.se3 import inverse

__all__ = ["KITTI", "VOD"]

_CAMERA, _TO_LIDAR, _RECTIFIED, _IMAGE = "Tr_velo_to_cam", "_to_velo", "R0_rect", "P2"
_NOTES = (
    "P0 to P3 are all K [I | 0] of the same camera: undistort its images before use.",
    "R0_rect is the identity: the camera's optical frame is used as the rectified frame.",
    (
        "Tr_imu_to_velo is the inverse of the lidar's pose on the car, or the identity if that pose is unknown: no IMU "
        "is calibrated."
    ),
)


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    only = sum(s.kind == "camera" for s in calibration.sensors) == 1
    cameras = cameras_of(calibration, "kitti")
    return {"calib.txt" if only else f"calib_{name}.txt": _of_camera(calibration, name) for name in cameras}


def _of_camera(calibration: ExportedCalibration, name: str) -> bytes:
    camera, lidar = needed_camera(calibration, "kitti", name), calibration.reference.name
    P = np.hstack([camera.K, np.zeros((3, 1))])
    T_lidar_base = np.eye(4) if calibration.T_base is None else inverse(calibration.T_base)
    values: dict[str, np.ndarray | None] = {
        **{f"P{k}": P for k in range(4)},
        _RECTIFIED: np.eye(3),
        _CAMERA: calibration.T_between(name, lidar),
        "Tr_imu_to_velo": T_lidar_base,
    }
    others = [s.name for s in calibration.sensors if s.kind != "camera" and s.name != lidar]
    values |= {f"Tr_{other}{_TO_LIDAR}": calibration.T_between(lidar, other) for other in others}
    # KITTI prints 12 digits after the point; with 16, reading gives the same float64.
    lines = (
        f"{name}: {' '.join(f'{v:.16e}' for v in M[:3].reshape(-1))}\n"
        for name, M in values.items()
        if M is not None
    )
    return "".join(lines).encode()  # some readers fail on the blank line at the end of KITTI's own files


def _read(files: Files, edges: Sequence[Edge], _names: FrameNames) -> dict[str, np.ndarray]:
    cameras = {edge.parent.name for edge in edges if edge.parent.kind == "camera"}
    found: dict[str, np.ndarray] = {}
    for file, content in files.items():
        lines = _lines(file, content)
        for edge in edges:
            of_file = len(cameras) == 1 or file.endswith(f"calib_{edge.parent.name}.txt")
            if edge.kind == "camera_lidar" and _CAMERA in lines and of_file:
                found[words_of(edge)] = _rectified(file, lines) @ matrix_of(file, _CAMERA, lines[_CAMERA])
            if edge.kind in ("lidar_radar", "lidar_lidar"):  # one of the two may be KITTI's velo
                keys = [f"Tr_{sensor.name}{_TO_LIDAR}" for sensor in edge.sensors]
                a, b = (matrix_of(file, k, lines[k]) if k in lines else np.eye(4) for k in keys)
                if lines.keys() & set(keys):
                    found[words_of(edge)] = inverse(a) @ b
    if not found:
        raise ConfigError(", ".join(files), _CAMERA, "missing")
    return found


def _read_vod(files: Files, _edges: Sequence[Edge], _names: FrameNames) -> dict[str, np.ndarray]:
    """View-of-Delft has one file per sensor; each holds its sensor's T_camera_sensor as Tr_velo_to_cam."""
    if len(files) != 2:
        problem = (
            "give two files: the lidar's calibration, then the radar's (lidar/.../calib, radar/.../calib)"
        )
        raise ConfigError("command line", "files", problem)
    lidar, radar = (
        _rectified(file, lines) @ matrix_of(file, _CAMERA, lines.get(_CAMERA, ()))
        for file, lines in ((f, _lines(f, content)) for f, content in files.items())
    )
    return {"camera_lidar": lidar, "lidar_radar": inverse(lidar) @ radar}


def _lines(file: str, content: bytes) -> dict[str, list[float]]:
    found = {}
    for line in text_of(file, content).splitlines():
        name, colon, numbers = line.partition(":")
        if not line.strip():
            continue
        if not colon:
            raise ConfigError(file, line.split()[0], "is not a line of the form NAME: NUMBERS")
        found[name.strip()] = _numbers(file, name.strip(), numbers.split())
    return found


def _numbers(file: str, name: str, words: Iterable[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as err:
        if name in (_CAMERA, _RECTIFIED, _IMAGE) or name.endswith(_TO_LIDAR):
            raise ConfigError(file, name, f"is not a number: {err}") from err
        return []  # a line with other content, such as calib_time


def _rectified(file: str, lines: dict[str, list[float]]) -> np.ndarray:
    """Transform from the reference camera to image_2's: rectification, and baseline by P2's last column."""
    T = np.eye(4)
    if (rectification := lines.get(_RECTIFIED)) is not None:
        if len(rectification) != 9:
            raise ConfigError(file, _RECTIFIED, f"needs 9 numbers and has {len(rectification)}")
        R = np.reshape(rectification, (3, 3))
        T = matrix_of(file, _RECTIFIED, np.hstack([R, np.zeros((3, 1))]))
    if (projection := lines.get(_IMAGE)) is not None:
        if len(projection) != 12 or not np.linalg.det(np.reshape(projection, (3, 4))[:, :3]):
            raise ConfigError(file, _IMAGE, "is not a 3x4 projection")
        P = np.reshape(projection, (3, 4))
        T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])
    return T


KITTI = Format("kitti", _write, read=_read, notes=_NOTES)
VOD = Format("vod", read=_read_vod)
