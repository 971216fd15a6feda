"""The standing reflector recording in the lake, and the reflector files of vehicle-days.

The file of picked reflectors is written by `boresight simulate --reflectors` and read by `evaluate`.

    {"vehicle": "vehicle-1", "day": "2026-03-02",        vehicle-day with this mounting; left out: every one
     "frames": 150,                                      number of frames of the recording
     "reflector": {"edge_m": 0.35},                      optional: length of a trihedral's edges at the apex;
                                                         opens towards the lidar, one edge upright, to 2 deg
     "camera": {"model", "K", "D", "width_px", "height_px"},
     "targets": [{"pixel": [u, v], "lidar_m": [x, y, z], "radar_m": [x, y, z],
                  "spread": {"pixel": [su, sv], "lidar_m": [sx, sy, sz], "radar_m": [sx, sy, sz]},
                  "frames": {"pixel": 1, "lidar_m": 1, "radar_m": 150}}, ...]}

Pixels refer to the full image, (0, 0) is the centre of its first pixel; metres are in each sensor's frame.
`spread` (optional) is the standard deviation of one pick, `frames` the number of picks in the mean position:
its standard error is spread / sqrt(frames). Other keys, such as the simulator's `truth`, are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import ConfigError, ContractError
from pipeline.evaluate.reflectors import Echoes, Found, find_in_lidar, find_in_radar
from pipeline.rig.cameras import Camera
from pipeline.rig.targets import Picks, PickUncertainty
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of

__all__ = ["ReflectorFile", "ReflectorFiles", "file_of_day", "find_again", "read_reflectors"]

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


_KEYS = ("pixel", "lidar_m", "radar_m")


@dataclass(frozen=True, eq=False)
class ReflectorFile:
    """Picks of one recording, the vehicle and day that they belong to, and the sources of the positions."""

    picks: Picks
    vehicle: str | None
    day: str | None
    edge_m: float | None
    sources: tuple[str, ...]  # sentences

    def applies_to(self, vehicle: str, day: str) -> bool:
        """True if the recording is valid for the mounting of that vehicle-day."""
        return self.vehicle in (None, vehicle) and self.day in (None, day)


def read_reflectors(path: Path) -> ReflectorFile:
    """Read a file of picked reflectors; raises ConfigError if missing or of another form."""
    try:
        content = json.loads(path.read_text())
        c, targets = content["camera"], content["targets"]
        size = int(c["width_px"]), int(c["height_px"])
        camera = Camera(c["model"], np.array(c["K"], float), np.array(c["D"], float), *size)
        at = {key: np.array([t[key] for t in targets], float) for key in _KEYS}
        spread = {key: _each(targets, "spread", key, np.zeros(at[key].shape[-1:])) for key in _KEYS}
        frames = {key: _each(targets, "frames", key, np.ones(1)) for key in _KEYS}
        error = {key: spread[key] / np.sqrt(frames[key].reshape(-1, 1)) for key in _KEYS}
        edge = content.get("reflector", {}).get("edge_m")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as err:
        raise ConfigError(str(path), "", f"not a readable reflector file: {err!r}") from err
    shapes = [a.shape[1:] for a in (*at.values(), *spread.values())]
    if not targets or shapes != [(2,), (3,), (3,)] * 2 or not all(np.isfinite(a).all() for a in at.values()):
        raise ConfigError(
            str(path), "targets", "each needs pixel [u, v], lidar_m [x, y, z] and radar_m [x, y, z], finite"
        )
    known = any("spread" in t for t in targets)
    picks = Picks(
        at["pixel"],
        at["lidar_m"],
        at["radar_m"],
        camera,
        spread=PickUncertainty(*(spread[key] for key in _KEYS)) if known else None,
        sigma=PickUncertainty(*(error[key] for key in _KEYS)) if known else None,
    )
    names = ("camera pixels", "lidar", "radar")
    counts = [f"{name}: picked, {_count(frames[key])}" for name, key in zip(names, _KEYS, strict=True)]
    sources = tuple(counts if known else [f"{name}: picked, spread unknown" for name in names])
    return ReflectorFile(picks, content.get("vehicle"), content.get("day"), edge, sources)


def find_again(
    file: ReflectorFile, lidar: list[Echoes] | None, radar: list[Echoes] | None, where: str
) -> ReflectorFile:
    """The file with lidar and radar positions measured in the frames of the recording, near the picks.

    A reflector that is not found in a sensor keeps its pick there; `sources` lists those.

    Args:
        file: picks, used as initial guesses.
        lidar: points and intensities of each frame; None if the log has no intensity.
        radar: points and power of each frame; None if the log has no power.
    """
    picks, edge = deepcopy(file.picks), file.edge_m
    in_lidar = [find_in_lidar(lidar, at, edge) if lidar else None for at in picks.lidar_m]
    in_radar = [find_in_radar(radar, at) if radar else None for at in picks.radar_m]
    none = PickUncertainty(*(np.zeros_like(at) for at in (picks.pixels, picks.lidar_m, picks.radar_m)))
    picks = replace(picks, spread=picks.spread or none, sigma=picks.sigma or deepcopy(none))
    for sensor, all_found in (("lidar_m", in_lidar), ("radar_m", in_radar)):
        for k, found in enumerate(all_found):
            if found is not None:
                getattr(picks, sensor)[k] = found.position_m
                getattr(picks.spread, sensor)[k] = found.spread_m
                getattr(picks.sigma, sensor)[k] = found.sigma_m
    how = f"apex of a {edge:g} m trihedral" if edge else "centre of the bright echoes, its apex is deeper,"
    sources = (
        file.sources[0],
        _source(f"lidar: {how}", in_lidar, where, file.sources[1]),
        _source("radar: strongest echo", in_radar, where, file.sources[2]),
    )
    return replace(file, picks=picks, sources=sources)


def _source(what: str, found: Sequence[Found | None], where: str, picked: str) -> str:
    """Sentence for `sources`: reflectors found in the recording, with frames, and source of the others."""
    hits = [f"{k} ({f.frames} frames)" for k, f in enumerate(found, 1) if f is not None]
    lost = [str(k) for k, f in enumerate(found, 1) if f is None]
    if not hits:
        return f"{picked}; none was found in {where}"
    text = f"{what} found in {where}, reflectors {', '.join(hits)}"
    return f"{text}; not found: {', '.join(lost)}, {picked}" if lost else text


def _each(targets: list[dict[str, Any]], group: str, key: str, default: np.ndarray) -> np.ndarray:
    return np.array([np.ravel(t.get(group, {}).get(key, default)) for t in targets], float)


def _count(frames: np.ndarray) -> str:
    if np.all(frames == 1):
        return "once"
    return f"mean of {' / '.join(f'{int(n)}' for n in frames.ravel())} frames"
