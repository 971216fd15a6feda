"""The standing reflector recording in the lake, and the reflector files of vehicle-days."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.core.errors import ConfigError, ContractError
from pipeline.evaluate.picks import ReflectorFile, find_again, read_reflectors
from pipeline.evaluate.reflectors import Echoes
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of

__all__ = ["ReflectorFiles", "file_of_day"]

_STANDING_MPS = 0.3  # odometry of a parked car is not exactly zero


class ReflectorFiles:
    """Reflector files by vehicle-day; each file is read, and its recording searched, once.

    Args:
        recording: lake with the ingested recordings, and their day if it differs from that of the picks.
    """

    def __init__(self, path: Path | None, recording: tuple[str, str | None] | None) -> None:
        self._path, self._recording = path, recording
        self._read: dict[Path, ReflectorFile] = {}

    def of(self, vehicle: str, day: str) -> ReflectorFile | None:
        """The file valid for the mounting of that vehicle-day; None if there is none."""
        path = file_of_day(self._path, vehicle, day)
        if path is None:
            return None
        if path not in self._read:
            self._read[path] = self._load(path)
        file = self._read[path]
        return file if file.applies_to(vehicle, day) else None

    def notes(self) -> list[str]:
        """Sources of the positions, as sentences."""
        several = len(self._read) > 1
        notes = [
            f"{path.parent.name}/{path.stem}: {source}" if several else source
            for path, file in self._read.items()
            for source in file.sources
        ]
        if notes:
            notes.append("a sensor's own bias (radar range, elevation) is in the truth, not in its sigma")
        return notes

    def _load(self, path: Path) -> ReflectorFile:
        file = read_reflectors(path)
        if self._recording is None:
            return file
        lake, day = self._recording
        day = day or file.day
        if file.vehicle is None or day is None:
            raise ConfigError(
                str(path), "vehicle", "a recording is found by the vehicle and day of its picks"
            )
        lidar, radar = _standing_echoes(Lake.at(lake), Partition(file.vehicle, day))
        return find_again(file, lidar, radar, f"{Path(lake).name} {file.vehicle} {day}")


def file_of_day(path: Path | None, vehicle: str, day: str) -> Path | None:
    """VEHICLE/DAY.json of a folder, None if missing; or the one file for all days."""
    if path is None or not path.is_dir():
        return path
    own = path / vehicle / f"{day}.json"
    return own if own.exists() else None


def _standing_echoes(lake: Lake, partition: Partition) -> tuple[list[Echoes] | None, list[Echoes] | None]:
    """Points and intensities of every frame, of lidar and radar; None for a sensor without intensity.

    Raises:
        ContractError: there is no such partition, or the car moves in it.
    """
    lidar, radar = [], []
    for frame in frames_of(lake, partition):
        if abs(frame.ego_speed_mps or 0.0) > _STANDING_MPS:
            problem = f"{partition.vehicle} moves on {partition.day}: no standing reflector recording"
            raise ContractError(str(lake), problem)
        lidar.append((frame.lidar_xyz_m, frame.lidar_intensity))
        radar.append((frame.radar_xyz_m, frame.radar_power_db))
    return _whole(lidar), _whole(radar)


def _whole(frames: list[tuple[np.ndarray, np.ndarray | None]]) -> list[Echoes] | None:
    known = [(points, strength) for points, strength in frames if strength is not None]
    return known if len(known) == len(frames) else None
