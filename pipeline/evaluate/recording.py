"""The standing reflector recording in the lake, and the reflector files of vehicle-days."""

from __future__ import annotations

from pathlib import Path

from pipeline.core.errors import ConfigError, ContractError
from pipeline.evaluate.picks import ReflectorFile, find_again, read_reflectors
from pipeline.evaluate.reflectors import Echoes
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of

__all__ = ["ReflectorFiles", "standing_echoes"]

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
        if self._path is None:
            return None
        path = self._path / vehicle / f"{day}.json" if self._path.is_dir() else self._path
        if self._path.is_dir() and not path.exists():
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
        lidar, radar = standing_echoes(Lake.at(lake), Partition(file.vehicle, day))
        return find_again(file, lidar, radar, f"{Path(lake).name} {file.vehicle} {day}")


def standing_echoes(lake: Lake, partition: Partition) -> tuple[list[Echoes] | None, list[Echoes] | None]:
    """Points and intensities of every frame, of lidar and radar; None for a sensor without intensity.

    Raises:
        ContractError: there is no such partition, or the car moves in it.
    """
    lidar: list[Echoes] = []
    radar: list[Echoes] = []
    frames = 0
    for frame in frames_of(lake, partition):
        if abs(frame.ego_speed_mps or 0.0) > _STANDING_MPS:
            problem = f"{partition.vehicle} moves on {partition.day}: no standing reflector recording"
            raise ContractError(str(lake), problem)
        frames += 1
        if frame.lidar_intensity is not None:
            lidar.append((frame.lidar_xyz_m, frame.lidar_intensity))
        if frame.radar_power_db is not None:
            radar.append((frame.radar_xyz_m, frame.radar_power_db))
    return (lidar if len(lidar) == frames else None), (radar if len(radar) == frames else None)
