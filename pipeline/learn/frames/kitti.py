"""Frames as a KITTI object folder: one camera, one lidar, up to one radar, with View-of-Delft's rows and V2X's line.

Source: KITTI object development kit, readme (label_2: DontCare values of boxes without 3D; calib: row-major
3x4); View-of-Delft development kit (radar rows, pose); V2X-Radar (Tr_radar_to_velo).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack

import numpy as np

from pipeline.errors import ConfigError
from pipeline.geometry.se3 import inverse
from pipeline.learn.frames.ego import T_root_sensor, compensated_range_rate
from pipeline.learn.frames.facts import facts_of, to_json
from pipeline.learn.frames.frame import Frame, points_of
from pipeline.learn.frames.images import undistortion_of
from pipeline.learn.frames.output import DayOutput, Output
from pipeline.store.partitions import Partition
from schemas.captures import Image, Scan, Sweep
from schemas.training import SPLITS

__all__ = ["KittiWriter", "finish_kitti"]

_NO_3D = "-1 -1 -10 {box} -1 -1 -1 -1000 -1000 -1000 -10 {score:.4f}"


class KittiWriter:
    """Writes training/FOLDER/NNNNNN.* of each frame; a frame without camera or lidar has no place in KITTI."""

    def __init__(self, output: DayOutput, stack: ExitStack) -> None:
        del stack  # files are whole when they are written
        self._output = output

    def add(self, frame: Frame) -> None:
        """Write a frame; ConfigError if a kind has two sensors, or a camera is too wide."""
        names = _one_of_each(frame)
        name = f"{frame.at.number:06d}"
        camera, sweep = frame.captures[names["camera"]], frame.captures[names["lidar"]]
        assert isinstance(camera, Image)
        assert isinstance(sweep, Sweep)
        self._image(name, frame, names["camera"], camera)
        self._put("velodyne", f"{name}.bin", points_of(sweep).tobytes())
        radar = frame.captures.get(names.get("radar", ""))
        if isinstance(radar, Scan):
            rows = points_of(radar)
            own = compensated_range_rate(frame, names["radar"], radar)
            columns = [*rows[:, :3].T, rows[:, 4], rows[:, 3], own, np.zeros(len(rows))]
            self._put("radar", f"{name}.bin", np.stack(columns, -1).astype("<f4").tobytes())
        self._put("calib", f"{name}.txt", _calib(frame, names, frame.T, camera.camera_K))
        if frame.answer is not None:
            self._put("calib_answer", f"{name}.txt", _calib(frame, names, frame.answer, camera.camera_K))
        if (T_odom := frame.T_odom_vehicle) is not None:
            T = T_odom @ T_root_sensor(frame, frame.mounting.T[names["camera"]])
            self._put("pose", f"{name}.json", json.dumps({"odomToCamera": T.ravel().tolist()}).encode())
        self._output.list(frame.at.split, name)
        self._output.list("frames", {"name": name, **facts_of(frame)})

    def close(self) -> None:
        """Nothing is held."""

    def _image(self, name: str, frame: Frame, sensor: str, image: Image) -> None:
        undistortion, seen = undistortion_of(image, sensor), frame.seen.get(sensor)
        self._put("image_2", f"{name}.png", undistortion.encoded(image, ".png"))
        if seen is not None:
            self._put("semantic", f"{name}.png", undistortion.labels(seen))
            lines = [
                f"{kind} {_NO_3D.format(box=' '.join(f'{v:.2f}' for v in box), score=score)}\n"
                for box, kind, score in undistortion.boxes(seen)
            ]
            self._put("label_2", f"{name}.txt", "".join(lines).encode())

    def _put(self, folder: str, name: str, data: bytes) -> None:
        self._output.put(f"training/{folder}/{name}", data)


def _one_of_each(frame: Frame) -> dict[str, str]:
    """Name of the sensor of each kind."""
    found: dict[str, str] = {}
    kinds = {Image: "camera", Sweep: "lidar", Scan: "radar"}
    for name, capture in frame.captures.items():
        kind = kinds[type(capture)]
        if kind in found:
            problem = (
                f"KITTI has one {kind}, and the rig has {found[kind]} and {name}: name one with --sensor"
            )
            raise ConfigError("command line", "sensor", problem)
        found[kind] = name
    return found


def _calib(frame: Frame, names: Mapping[str, str], T: Mapping[str, np.ndarray], K: np.ndarray) -> bytes:
    T_lidar_reference = inverse(T[names["lidar"]])
    T_base = frame.mounting.T_base_reference
    P = np.hstack([K, np.zeros((3, 1))])
    values = {f"P{k}": P for k in range(4)} | {
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": inverse(T[names["camera"]])[:3] @ T[names["lidar"]],
        "Tr_imu_to_velo": (np.eye(4) if T_base is None else T_lidar_reference @ inverse(T_base))[:3],
    }
    if "radar" in names:
        values["Tr_radar_to_velo"] = T_lidar_reference[:3] @ T[names["radar"]]
    lines = (f"{name}: {' '.join(f'{v:.16e}' for v in M.reshape(-1))}\n" for name, M in values.items())
    return "".join(lines).encode()


def finish_kitti(output: Output, days: Sequence[Partition]) -> None:
    """Write the lists of all splits, and frames.jsonl, a line with the facts of each frame."""
    names: dict[str, list[str]] = {split: [] for split in SPLITS}
    with output.replacing("frames.jsonl") as stream:
        for day in days:
            for part, row in output.rows(day):
                if part == "frames":
                    stream.write(to_json(row) + b"\n")
                elif part in names:
                    names[part].append(row)
    for split, own in names.items():
        output.write(f"ImageSets/{split}.txt", "".join(f"{name}\n" for name in sorted(own)).encode())
