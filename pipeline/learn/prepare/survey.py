"""Survey of a day for the plan: place, time and reference (by `joint`) of its frames, which can become samples."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.core.config import PrepareConfig
from pipeline.learn.prepare.split import SplitPlan, Unit, environment_of_speeds, plan_split
from pipeline.learn.sample.frame_sample import Reference
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import pose_of
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.tables import read_columns
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, CalibrationRecord
from schemas.moments import MOMENTS, PERCEIVED

__all__ = ["Survey", "plan_days", "reference_of", "survey_day", "usable_records"]

_LIGHT = ("moment", "log", "drive", "stamp_ns", "ego_speed_mps", "ego_tx_m", "ego_ty_m")


@dataclass(frozen=True, eq=False)
class Survey:
    """Survey of one vehicle-day, one entry per frame in order of time."""

    partition: Partition
    stamp_s: np.ndarray
    drive: np.ndarray
    perceived: np.ndarray  # bool: the frame has an observation
    moved: np.ndarray  # bool: the vehicle moved since the last frame that counts
    place: list[str]
    x_m: np.ndarray  # by odometry; NaN without
    y_m: np.ndarray
    environment: list[str]  # of the frame's drive

    @property
    def usable(self) -> np.ndarray:
        """Frames that can become samples."""
        return self.perceived & self.moved

    def reached(self, frame: int, config: PrepareConfig) -> set[str]:
        """Places that a square of `guard_m` around a frame reaches, its own among them."""
        x, y, half = self.x_m[frame], self.y_m[frame], config.split.guard_m / 2
        if not (np.isfinite(x) and np.isfinite(y)):
            return {self.place[frame]}
        home, colon, _ = self.place[frame].rpartition(":")
        steps = itertools.product((-half, 0.0, half), repeat=2)
        return {home + colon + _cell_of(x + dx, y + dy, config.split.place_m) for dx, dy in steps}


def survey_day(partition: Partition, lake: Lake, config: PrepareConfig) -> Survey:
    """Survey a vehicle-day without reading images or points; raises ContractError if it was not perceived."""
    light = read_columns(lake, MOMENTS, partition, _LIGHT)
    perceived = set(read_columns(lake, PERCEIVED, partition, ["moment"])["moment"])
    stamp = np.array(light["stamp_ns"], np.int64) * 1e-9
    drive = np.array(light["drive"], np.int64)
    x, y, speed = (np.array(light[n], np.float64) for n in ("ego_tx_m", "ego_ty_m", "ego_speed_mps"))
    speeds: dict[int, list[float | None]] = {int(d): [] for d in drive}
    for d, of_frame in zip(drive, light["ego_speed_mps"], strict=True):
        speeds[int(d)].append(of_frame)
    environments = {d: environment_of_speeds(of_drive) for d, of_drive in speeds.items()}
    return Survey(
        partition, stamp, drive, np.array([i in perceived for i in light["moment"]], bool),
        _moved(stamp, drive, np.nan_to_num(speed, nan=np.inf), config.min_step_m),
        _places(partition, light["log"], drive, stamp, x, y, config), x, y,
        [environments[int(d)] for d in drive],
    )  # fmt: skip


def plan_days(
    surveys: Sequence[Survey], config: PrepareConfig, decided: Mapping[tuple[str, str], str]
) -> SplitPlan:
    """Divide the usable frames of all days; `decided` as `decided_sides` returns them."""
    counts = Counter(
        (s.partition.vehicle, s.partition.day, place)
        for s in surveys
        for place, usable in zip(s.place, s.usable, strict=True)
        if usable
    )
    units = [Unit(*key, frames) for key, frames in sorted(counts.items())]
    split = config.split
    return plan_split(units, split.by, split.val_fraction, split.test_fraction, config.seed, decided)


def _cell_of(x_m: float, y_m: float, side_m: float) -> str:
    """Name of the square cell of the map that holds a position."""
    return f"{int(x_m // side_m)},{int(y_m // side_m)}"  # of -0.0 a float would print -0, another name


def _moved(stamp: np.ndarray, drive: np.ndarray, speed: np.ndarray, step_m: float) -> np.ndarray:
    """True for frames at least `step_m` of driving behind the last such frame; unknown speeds count as fast."""
    out = np.ones(len(stamp), bool)
    way = 0.0
    for i in range(1, len(stamp)):
        if drive[i] != drive[i - 1]:
            way = 0.0
            continue
        way += (stamp[i] - stamp[i - 1]) * (abs(speed[i]) + abs(speed[i - 1])) / 2
        out[i] = way >= step_m
        if out[i]:
            way = 0.0
    return out


def _places(
    partition: Partition, log: Sequence[str], drive: np.ndarray, stamp: np.ndarray, x: np.ndarray,
    y: np.ndarray, config: PrepareConfig,
) -> list[str]:  # fmt: skip
    """A cell of the map, a cell of the log's own odometry, or a stretch of the drive."""
    begin = {int(d): float(stamp[drive == d].min()) for d in np.unique(drive)}
    names = []
    for i in range(len(stamp)):
        home = "" if config.split.positions == "map" else f"{partition.vehicle}/{partition.day}/{log[i]}:"
        if np.isfinite(x[i]) and np.isfinite(y[i]):
            names.append(home + _cell_of(x[i], y[i], config.split.place_m))
        else:
            stretch = int((stamp[i] - begin[int(drive[i])]) // config.split.place_s)
            names.append(f"{partition.vehicle}/{partition.day}/drive {drive[i]}, stretch {stretch}")
    return names


def usable_records(
    lake: Lake, partition: Partition, chosen: Mapping[str, str]
) -> dict[str, CalibrationRecord]:
    """By pair, the day's records of `joint` that are accepted, or held for nothing but their sigma.

    Args:
        chosen: names of the camera, lidar and radar.
    """
    edges = {(chosen.get(a), chosen.get(b)): pair for pair, (a, b) in FRAMES_OF_PAIR.items()}
    rows = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle, day=partition.day)
    return {
        edges[edge]: row
        for row in current_records(rows)
        if row.method == "joint" and (edge := (row.parent_frame, row.child_frame)) in edges
        if row.status == "accepted" or row.diagnostics.get("unsure_only")
    }


def reference_of(records: Mapping[str, CalibrationRecord], prior: Prior) -> Reference:
    """Poses and clocks of the records; without one of camera-lidar, the prior."""
    camera, radar = (records.get(pair) for pair in ("camera_lidar", "lidar_radar"))
    if camera is None:
        return Reference(prior)
    T_camera_lidar = transform_of(camera)
    T_lidar_radar = prior.T_lidar_radar if radar is None else transform_of(radar)
    assert T_camera_lidar is not None and T_lidar_radar is not None  # noqa: PT018 - usable records have poses
    dt_s, own = camera.time_offset_s or 0.0, pose_of(partial(getattr, camera), "own_")
    if camera.diagnostics.get("own_dt_z") == 0.0 and own is not None:
        # Where the edge's own borders match, pose and offset of one solution: the adjusted offset of an unsure day is
        # drawn to the prior's.
        T_camera_lidar, dt_s = own, camera.diagnostics["own_dt_s"]
    poses = replace(prior, T_camera_lidar=T_camera_lidar, T_lidar_radar=T_lidar_radar)
    return Reference(poses, "joint", dt_s, 0.0 if radar is None else radar.time_offset_s or 0.0)
