"""What the range-image network learns from: sweeps as images, of which the part that the camera sees has labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float16, UInt8

from pipeline.geometry.range_image import EMPTY, channels_of, project
from pipeline.learn.perception.lidar_semantics.labels import UNLABELLED, project_labels
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["SweepImages", "SweepLayout", "cut", "day_images", "layout_of", "sweep_of"]

_BRIGHTEST = 60_000.0  # in sixteen bits
_EDGE_PX = 8  # beyond the labels: what their pixels' neighbourhoods show


@dataclass(frozen=True)
class SweepLayout:
    """Geometry of the images, as in the model's manifest; the columns go all the way round."""

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
    """Range, x, y, z [m], remission of the pixels around the labels; EMPTY in all five where no point is."""

    channels: Float16[np.ndarray, "N 5 H W"]
    label: UInt8[np.ndarray, "N H W"]

    def __len__(self) -> int:
        return len(self.label)


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

    Args:
        frames: in their order; those that perception rejected have no observation and are left out.
        observations: of the same day.
        T_camera_lidar: the current calibration, never a truth.
        layout: of the images.
        limit: how many to keep.
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
