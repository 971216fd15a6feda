"""Training samples of the range-image network: sweeps as images, labelled where the camera sees them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float16, Float32, UInt8

from pipeline.core.config import FleetConfig
from pipeline.learn.perception_training.days import is_held_out, vehicle_days
from pipeline.learn.perception_training.lidar_semantics.labels import UNLABELLED, project_labels
from pipeline.rig.day_prior import read_prior
from pipeline.rig.range_image import EMPTY, channels_of, project
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from pipeline.store.views import frames_of, observations_of
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "Normal",
    "SweepImages",
    "SweepLayout",
    "SweepSamples",
    "cut",
    "day_images",
    "labelled_sweeps",
    "layout_of",
    "normal_of",
]

_BRIGHTEST = 60_000.0  # in sixteen bits
_EDGE_PX = 8  # beyond the labels: what their pixels' neighbourhoods show


@dataclass(frozen=True)
class SweepLayout:
    """Geometry of the images, as in the model's manifest; the columns cover 360 deg."""

    rows: int
    columns: int
    fov_up_deg: float
    fov_down_deg: float

    @property
    def size(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.rows, self.columns


@dataclass(frozen=True, eq=False)
class SweepImages:
    """Range, x, y, z [m], remission of the pixels around the labels; EMPTY in all five without a point."""

    channels: Float16[np.ndarray, "N 5 H W"]
    label: UInt8[np.ndarray, "N H W"]

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class Normal:
    """Mean and deviation of the five channels where points are, as in the manifest."""

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def apply(self, channels: np.ndarray) -> Float32[np.ndarray, "N 5 H W"]:
        """Normalised channels, 0 in empty pixels."""
        mean, std = (np.array(v, np.float32)[:, None, None] for v in (self.mean, self.std))
        filled = channels[:, :1] != EMPTY
        return np.where(filled, (channels.astype(np.float32) - mean) / std, 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SweepSamples:
    """Training sweeps, held-out sweeps, their layout, and their numbers for the card."""

    train: SweepImages
    held_out: SweepImages
    layout: SweepLayout
    numbers: dict[str, int]


def labelled_sweeps(
    fleet: FleetConfig, lake: Lake, size: tuple[int, int], frames_per_day: int
) -> SweepSamples:
    """Sweeps of all vehicle-days with observations; every fifth day is held out.

    Each day by its accepted camera-lidar calibration where the lake has one, else by its prior.

    Raises:
        ContractError: fewer than two vehicle-days of vehicles in fleet.toml.
    """
    days = vehicle_days(fleet, lake, least=2)
    chosen = {day.vehicle: fleet.rig_of(day.vehicle).one_of_each("training") for day in days}
    accepted = {
        (r.vehicle, r.day): transform_of(r)
        for r in current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
        if r.status == "accepted" and _is_of(r, chosen)
    }
    layout = layout_of((next(frames_of(lake, day, chosen=chosen[day.vehicle])) for day in days), *size)
    sides: tuple[list[tuple[np.ndarray, np.ndarray]], ...] = ([], [])
    for number, day in enumerate(days):
        names = chosen[day.vehicle]
        rows = list(observations_of(lake, day, chosen=names))
        known = accepted.get((day.vehicle, day.day))
        T = read_prior(rows, fleet, day.vehicle).T_camera_lidar if known is None else known
        sides[is_held_out(number)].extend(
            day_images(frames_of(lake, day, chosen=names), rows, T, layout, frames_per_day)
        )
    train, held_out = cut(*sides)
    numbers = {
        "vehicle_days": len(days),
        "calibrated_days": sum((day.vehicle, day.day) in accepted for day in days),
        "samples": len(train),
        "held_out_samples": len(held_out),
    }
    return SweepSamples(train, held_out, layout, numbers)


def _is_of(record: CalibrationRecord, chosen: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether a record is of its vehicle's chosen camera and lidar."""
    names = chosen.get(record.vehicle, {})
    return (record.parent_frame, record.child_frame) == (names.get("camera"), names.get("lidar"))


def normal_of(images: SweepImages) -> Normal:
    """Statistics of the channels where points are; a channel that never changes is left as it is."""
    values = images.channels.transpose(1, 0, 2, 3)[:, images.channels[:, 0] != EMPTY].astype(np.float64)
    std = values.std(axis=1)
    return Normal(
        tuple(float(v) for v in values.mean(axis=1)), tuple(float(s) if s > 0 else 1.0 for s in std)
    )


def sweep_of(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Finite points and their remission as logged; a log without intensity has none, 0 everywhere."""
    xyz = np.stack([frame.lidar_x_m, frame.lidar_y_m, frame.lidar_z_m], axis=1)
    intensity = np.zeros(len(xyz), np.float32) if frame.lidar_intensity is None else frame.lidar_intensity
    kept = np.isfinite(xyz).all(axis=1)
    return xyz[kept], np.clip(np.nan_to_num(intensity[kept].astype(np.float32)), 0, _BRIGHTEST)


def layout_of(frames: Iterable[Frame], rows: int, columns: int) -> SweepLayout:
    """A layout that holds nearly all points of these sweeps."""
    elevations = []
    for frame in frames:
        xyz, _ = sweep_of(frame)
        range_m = np.linalg.norm(xyz, axis=1)
        elevations.append(np.degrees(np.arcsin(xyz[range_m > 0, 2] / range_m[range_m > 0])))
    low, high = np.percentile(np.concatenate(elevations), [0.1, 99.9])
    return SweepLayout(rows, columns, float(np.ceil(high)), float(np.floor(low)))


def day_images(
    frames: Iterable[Frame],
    observations: Sequence[Observation],
    T_camera_lidar: Float[np.ndarray, "4 4"],
    layout: SweepLayout,
    limit: int,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Channels and labels, whole images, of at most `limit` frames of a vehicle-day, evenly spread.

    Frames that perception rejected are left out. `T_camera_lidar` is the current calibration, never a truth.
    """
    chosen = np.linspace(0, len(observations) - 1, min(limit, len(observations))).astype(int)
    wanted = {observations[i].frame_index: observations[i] for i in chosen}
    made = []
    for frame in frames:
        observation = wanted.get(frame.frame_index)
        if observation is not None:
            made.append(_image(frame, observation, T_camera_lidar, layout))
    return made


def cut(
    train: Sequence[tuple[np.ndarray, np.ndarray]], held_out: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[SweepImages, SweepImages]:
    """Both sides as arrays, cut to the columns where either has labels."""
    labels = [label for _, label in (*train, *held_out)]
    shown = (
        np.any([(label != UNLABELLED).any(axis=0) for label in labels], axis=0)
        if labels
        else np.ones(2, bool)
    )
    columns = np.flatnonzero(shown) if shown.any() else np.arange(len(shown))
    first, last = max(0, int(columns[0]) - _EDGE_PX), min(len(shown), int(columns[-1]) + 1 + _EDGE_PX)
    last -= (last - first) % 2  # the network halves the columns
    return _stacked(train, first, last), _stacked(held_out, first, last)


def _stacked(images: Sequence[tuple[np.ndarray, np.ndarray]], first: int, last: int) -> SweepImages:
    if not images:
        return SweepImages(np.zeros((0, 5, 1, 2), np.float16), np.zeros((0, 1, 2), np.uint8))
    return SweepImages(
        np.stack([channels[:, :, first:last] for channels, _ in images]).astype(np.float16),
        np.stack([label[:, first:last] for _, label in images]),
    )


def _image(
    frame: Frame, observation: Observation, T_camera_lidar: np.ndarray, layout: SweepLayout
) -> tuple[np.ndarray, np.ndarray]:
    xyz, remission = sweep_of(frame)
    image = project(xyz, layout.size, layout.fov_up_deg, layout.fov_down_deg)
    labels = project_labels(observation, T_camera_lidar, xyz)
    filled = image.point != EMPTY
    drawn = np.full(layout.size, UNLABELLED, np.uint8)
    drawn[filled] = labels[image.point[filled]]
    return channels_of(image, xyz, remission), drawn
