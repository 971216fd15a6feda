"""Classes of lidar points by a range-image network that learns from the camera.

Samples are sweeps as images, labelled where the camera sees them; scores compare with labels of held-out days.

Labels are weak, due to errors of calibration and semantics. A point takes the class of its pixel if all pixels around
agree: near boundaries, a small error of the calibration or the distance between the sensors would give it the
neighbour's class. Points hidden from the camera have no label.

Source: paper, section 4.2 (RangeNet++); labels of SemanticKITTI, so that larger networks can replace this one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from pipeline.core.config import FleetConfig
from pipeline.core.rows import columns_of
from pipeline.learn.perception_training.trainer import (
    Labelled,
    Samples,
    Task,
    TrainingConfig,
    split_days,
    vehicle_days,
)
from pipeline.learn.prepare.survey import usable_records
from pipeline.learn.train.settings import Count
from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import camera_of
from pipeline.rig.day_prior import read_prior
from pipeline.rig.scan_rows import EMPTY, channels_of, project
from pipeline.rig.se3 import transform_points
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, observations_of
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "GROUND", "KINDS", "KIND_OF_LABEL", "LABELS", "UNLABELLED", "LidarSemantics", "SweepImages",
    "SweepLayout", "SweepTraining", "cut", "day_images", "hidden_points", "project_labels", "standing_points",
]  # fmt: skip

UNLABELLED = 0
# In the order of semantic-kitti.yaml's learning_map_inv.
LABELS = (
    "unlabeled", "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist",
    "road", "parking", "sidewalk", "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole",
    "traffic-sign",
)  # fmt: skip
# What perception makes of them.
KINDS = ("unknown", "road", "flat", "road_user", "other")
KIND_OF_LABEL: UInt8[np.ndarray, " 20"] = np.array([0, *[3] * 8, 1, 1, 2, 2, 4, 4, 4, 4, 2, 4, 4], np.uint8)
GROUND = (1, 2)  # kinds
# Cityscapes train ids, 0 road .. 18 bicycle, by name of the label that each becomes; no sky among points.
_OF_CITYSCAPES = (
    "road", "sidewalk", "building", "building", "fence", "pole", "traffic-sign", "traffic-sign", "vegetation",
    "terrain", "unlabeled", "person", "bicyclist", "car", "truck", "other-vehicle", "other-vehicle", "motorcycle",
    "bicycle",
)  # fmt: skip
_MARGIN_DEG = 0.25  # how far around a point's pixel the image must be of one class
# What stands is taller than this within a cell of azimuth and range, and covers so much around each of its points: half
# of what rows and columns of sparse sweeps are apart. What lies less than a cell behind may be the same thing.
_STANDS_M, _CELL_RAD, _CELL_M = 0.3, np.radians(1.0), 1.0
_COVERS_RAD = np.radians([0.25, 0.7])  # azimuth, elevation
_TABLE = np.zeros(256, np.uint8)
_TABLE[: len(_OF_CITYSCAPES)] = [LABELS.index(name) for name in _OF_CITYSCAPES]


def project_labels(
    observation: Observation, T_camera_lidar: Float[np.ndarray, "4 4"], xyz_m: Float32[np.ndarray, "N 3"]
) -> UInt8[np.ndarray, " N"]:
    """Label of each point of the sweep (finite points, lidar frame); UNLABELLED if the camera shows none."""
    image = labels_of(observation)
    camera = camera_of(observation).scaled(observation.label_scale)
    half = max(1, round(np.radians(_MARGIN_DEG) * camera.focal_px[0]))
    window = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    agreed = cv2.erode(image, window) == cv2.dilate(image, window)
    points_camera = transform_points(T_camera_lidar, xyz_m.astype(np.float64))
    uv, valid = camera.project(points_camera)
    valid &= ~hidden_points(points_camera, standing_points(xyz_m))
    pixel = np.rint(np.where(valid[:, None], uv, -1)).astype(np.int64)
    height, width = image.shape
    seen = valid & (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
    u, v = np.where(seen, pixel[:, 0], 0), np.where(seen, pixel[:, 1], 0)
    return np.where(seen & agreed[v, u], _TABLE[image[v, u]], UNLABELLED).astype(np.uint8)


def standing_points(xyz_m: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Points of upright objects: other points of the same direction and range are higher or lower (lidar frame)."""
    azimuth = np.floor(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / _CELL_RAD).astype(np.int64)
    ring = np.floor(np.hypot(xyz_m[:, 0], xyz_m[:, 1]) / _CELL_M).astype(np.int64)
    _, cell = np.unique(azimuth * 100_000 + ring, return_inverse=True)
    cell = cell.ravel()
    highest, lowest = np.full(cell.max(initial=0) + 1, -np.inf), np.full(cell.max(initial=0) + 1, np.inf)
    np.maximum.at(highest, cell, xyz_m[:, 2])
    np.minimum.at(lowest, cell, xyz_m[:, 2])
    return np.asarray((highest - lowest)[cell] > _STANDS_M)


def hidden_points(
    points_camera: Float[np.ndarray, "N 3"], standing: Bool[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Points hidden from the camera by standing objects (optical frame)."""
    range_m = np.linalg.norm(points_camera, axis=1)
    ahead = points_camera[:, 2] > 0
    azimuth = np.arctan2(points_camera[:, 0], points_camera[:, 2])
    angles = np.stack([azimuth, -points_camera[:, 1] / range_m], 1)
    row = np.floor((angles + np.pi) / _COVERS_RAD).astype(np.int64)
    nearest = np.full((2 * np.pi / _COVERS_RAD).astype(int) + 3, np.inf, np.float32)
    who = standing & ahead
    np.minimum.at(nearest, (row[who, 0], row[who, 1]), range_m[who])
    around = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    return np.asarray(ahead & (range_m > around[row[:, 0], row[:, 1]] + _CELL_M))


_CHANNELS = 5
_DILATIONS = ((1, 1), (1, 2), (2, 4), (1, 1))  # rows, columns
_BRIGHTEST = 60_000.0  # in sixteen bits
_BRIGHTNESS = 0.2  # remission of lidars of one make differs by as much
_EDGE_PX = 8  # beyond the labels: what their pixels' neighbourhoods show


class SweepTraining(TrainingConfig):
    """Defaults that suit some hundred sweeps."""

    steps: int = 400
    batch_size: int = 4
    learning_rate: float = 4e-3
    width: int = 16
    frames_per_day: int = 30
    rows: Count = 48  # of the range image, over the lidar's field of view
    columns: Count = 1024  # over 360 deg


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
class SweepImages(Labelled):
    """Range, x, y, z [m], remission of the pixels around the labels; EMPTY in all five without a point."""

    channels: Float16[np.ndarray, "N 5 H W"]
    label: UInt8[np.ndarray, "N H W"]
    layout: SweepLayout  # of the whole images


class SweepNetwork(nn.Module):
    """Normalised range image to logits of the 20 labels: 60 k parameters at width 16. Even numbers of columns."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.first = nn.Conv2d(_CHANNELS, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=(1, 2), padding=1)
        self.blocks = nn.ModuleList(
            nn.Conv2d(2 * width, 2 * width, 3, padding=d, dilation=d) for d in _DILATIONS
        )
        self.up = nn.Conv2d(3 * width, width, 3, padding=1)
        self.last = nn.Conv2d(width, len(LABELS), 1)

    def forward(self, image: Float[Tensor, "B 5 H W"]) -> Float[Tensor, "B L H W"]:
        """Logits."""
        fine = torch.relu(self.first(image))
        x = torch.relu(self.down(fine))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        x = functional.interpolate(x, scale_factor=(1.0, 2.0), mode="nearest")
        logits: Tensor = self.last(torch.relu(self.up(torch.cat([fine, x], dim=1))))
        return logits


def _sweep_of(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Finite points and their remission as logged; a log without intensity has none, 0 everywhere."""
    xyz = np.stack([frame.lidar_x_m, frame.lidar_y_m, frame.lidar_z_m], axis=1)
    intensity = np.zeros(len(xyz), np.float32) if frame.lidar_intensity is None else frame.lidar_intensity
    kept = np.isfinite(xyz).all(axis=1)
    return xyz[kept], np.clip(np.nan_to_num(intensity[kept].astype(np.float32)), 0, _BRIGHTEST)


def _layout_of(frames: Iterable[Frame], rows: int, columns: int) -> SweepLayout:
    """A layout that holds nearly all points of these sweeps."""
    elevations = []
    for frame in frames:
        xyz, _ = _sweep_of(frame)
        range_m = np.linalg.norm(xyz, axis=1)
        elevations.append(np.degrees(np.arcsin(xyz[range_m > 0, 2] / range_m[range_m > 0])))
    low, high = np.percentile(np.concatenate(elevations), [0.1, 99.9])
    return SweepLayout(rows, columns, float(np.ceil(high)), float(np.floor(low)))


def day_images(
    frames: Iterable[Frame], observations: Sequence[Observation], T_camera_lidar: Float[np.ndarray, "4 4"],
    layout: SweepLayout, limit: int,
) -> SweepImages:  # fmt: skip
    """Whole images of at most `limit` frames of a vehicle-day, evenly spread.

    Frames that perception rejected are left out. `T_camera_lidar` is the current calibration, never a truth.
    """
    chosen = np.linspace(0, len(observations) - 1, min(limit, len(observations))).astype(int)
    wanted = {observations[i].frame_index: observations[i] for i in chosen}
    pairs = ((frame, wanted.get(frame.frame_index)) for frame in frames)
    made = [_image(frame, own, T_camera_lidar, layout) for frame, own in pairs if own is not None]
    kinds = np.dtype([("channels", "f2", (_CHANNELS, *layout.size)), ("label", "u1", layout.size)])
    return SweepImages(**columns_of(made, kinds), layout=layout)


def cut(samples: Samples[SweepImages]) -> Samples[SweepImages]:
    """Both sides cut to the columns where either has labels."""
    sides = (samples.train, samples.held_out)
    shown = np.any([(side.label != UNLABELLED).any(axis=(0, 1)) for side in sides], axis=0)
    columns = np.flatnonzero(shown) if shown.any() else np.arange(len(shown))
    first, last = max(0, int(columns[0]) - _EDGE_PX), min(len(shown), int(columns[-1]) + 1 + _EDGE_PX)
    last -= (last - first) % 2  # the network halves the columns
    part = slice(first, last)
    train, held_out = (
        replace(side, channels=side.channels[..., part].copy(), label=side.label[..., part].copy()) for side in sides
    )  # fmt: skip
    return replace(samples, train=train, held_out=held_out)


def _image(
    frame: Frame, observation: Observation, T_camera_lidar: np.ndarray, layout: SweepLayout
) -> tuple[np.ndarray, np.ndarray]:
    xyz, remission = _sweep_of(frame)
    image = project(xyz, layout.size, layout.fov_up_deg, layout.fov_down_deg)
    labels = project_labels(observation, T_camera_lidar, xyz)
    filled = image.point != EMPTY
    drawn = np.full(layout.size, UNLABELLED, np.uint8)
    drawn[filled] = labels[image.point[filled]]
    return channels_of(image, xyz, remission), drawn


class LidarSemantics(Task[SweepImages]):
    """Channels are normalised and labels weighted as in the samples to learn from."""

    name = "lidar_semantics"
    purpose = "classes of lidar points (paper, section 4.2): lidar.semantics of a rig"
    limits = (
        "Learned from the camera's classes through a calibration, with the errors of both.",
        "Thin objects were learned from their middles only; objects outside the camera's view were not learned.",
        "Valid for the lidars, roads and weather of its samples only; remission must be logged as by these lidars.",
    )
    config = SweepTraining
    unlabelled = UNLABELLED
    network = SweepNetwork

    def __init__(self, train: SweepImages) -> None:
        super().__init__(train)
        values = train.channels.transpose(1, 0, 2, 3)[:, train.channels[:, 0] != EMPTY].astype(np.float64)
        std = values.std(axis=1)
        # Of the channels where points are; a channel that never changes is left as it is.
        self.mean, self.std = values.mean(axis=1), np.where(std > 0, std, 1.0)
        self.weight = _weights(train.label)

    @staticmethod
    def samples(fleet: FleetConfig, lake: Lake, config: SweepTraining) -> Samples[SweepImages]:
        """Sweeps of all vehicle-days with observations, each by its usable record of `joint`, else by its prior."""
        days = vehicle_days(fleet, lake)
        chosen = {day.vehicle: fleet.rig_of(day.vehicle).one_of_each("training") for day in days}
        known = {day: usable_records(lake, day, chosen[day.vehicle]).get("camera_lidar") for day in days}
        first = (next(frames_of(lake, day, chosen=chosen[day.vehicle])) for day in days)
        layout = _layout_of(first, config.rows, config.columns)

        def of_day(day: Partition) -> SweepImages:
            names = chosen[day.vehicle]
            rows = list(observations_of(lake, day, chosen=names))
            T = None if (record := known[day]) is None else transform_of(record)
            T = read_prior(rows, fleet, day.vehicle).T_camera_lidar if T is None else T
            return day_images(frames_of(lake, day, chosen=names), rows, T, layout, config.frames_per_day)

        found = cut(split_days(days, of_day))
        calibrated = sum(record is not None for record in known.values())
        return replace(found, numbers=found.numbers | {"calibrated_days": calibrated})

    def loss(self, network: nn.Module, batch: SweepImages, rng: np.random.Generator) -> Float[Tensor, ""]:
        """Weighted cross-entropy of the varied batch over its labelled pixels."""
        channels, label = _varied(batch, rng)
        target = torch.from_numpy(label.astype(np.int64))
        given = network(self._normalised(channels)), target, self.weight
        total = functional.cross_entropy(*given, ignore_index=UNLABELLED, reduction="sum")
        return total / self.weight[target].sum().clamp(min=1e-6)

    def scores(self, network: nn.Module, held_out: SweepImages) -> dict[str, float]:
        """Share of labelled pixels with the right kind, and IoU of ground and of each kind among the labels."""
        batches = (held_out.channels[i : i + 8] for i in range(0, len(held_out), 8))
        with torch.no_grad():
            label = np.concatenate([network(self._normalised(b)).argmax(1).numpy() for b in batches])
        known = held_out.label != UNLABELLED
        found, wanted = KIND_OF_LABEL[label[known]], KIND_OF_LABEL[held_out.label[known]]
        scores = {"accuracy": float(np.mean(found == wanted))}
        sets = {"ground": GROUND} | {KINDS[k]: (k,) for k in range(1, len(KINDS))}
        for name, kinds in sets.items():
            a, b = np.isin(found, kinds), np.isin(wanted, kinds)
            if b.any():
                scores[f"iou_{name}"] = float(np.sum(a & b) / np.sum(a | b))
        return scores

    def graph(self, network: nn.Module) -> tuple[nn.Module, Tensor, tuple[str, str], str]:
        """Range image to logits, in RangeNet++'s convention."""
        layout = self.train.layout
        image = {
            "size": list(layout.size), "fov_up_deg": layout.fov_up_deg, "fov_down_deg": layout.fov_down_deg,
            "mean": self.mean.tolist(), "std": self.std.tolist(), "empty": "zero",
        }  # fmt: skip
        lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in image.items())
        output = '[output]\nlayout = "logits"\nlabel_set = "semantickitti"\n'
        manifest = f'task = "segment_points"\n\n[input]\n{lines}\n{output}'
        return network, torch.zeros(1, _CHANNELS, *layout.size), ("points", "logits"), manifest

    def _normalised(self, channels: np.ndarray) -> Float[Tensor, "N 5 H W"]:
        """Normalised channels, 0 in empty pixels."""
        mean, std = (v.astype(np.float32)[:, None, None] for v in (self.mean, self.std))
        filled = channels[:, :1] != EMPTY
        values = np.where(filled, (channels.astype(np.float32) - mean) / std, 0)
        return torch.from_numpy(values.astype(np.float32))


def _varied(batch: SweepImages, rng: np.random.Generator) -> tuple[np.ndarray, Int[np.ndarray, "N H W"]]:
    """Each sweep rotated about the vertical, possibly mirrored, brighter or darker.

    Labels exist only in the camera's view; with rotated sweeps, objects on all sides are learned.
    """
    channels, label = batch.channels.astype(np.float32), batch.label.astype(np.int64)
    for i in range(len(batch)):
        filled = channels[i, 0] != EMPTY
        if rng.random() < 0.5:
            channels[i], label[i] = channels[i, :, :, ::-1].copy(), label[i, :, ::-1].copy()
            filled = filled[:, ::-1]
            channels[i, 2][filled] *= -1
        angle = rng.uniform(-np.pi, np.pi)
        x, y = channels[i, 1][filled], channels[i, 2][filled]
        channels[i, 1][filled] = np.cos(angle) * x - np.sin(angle) * y
        channels[i, 2][filled] = np.sin(angle) * x + np.cos(angle) * y
        channels[i, 4][filled] *= rng.uniform(1 - _BRIGHTNESS, 1 + _BRIGHTNESS)
    return channels, label


def _weights(label: np.ndarray) -> torch.Tensor:
    """Weight of each label in the loss: one over the root of its share, so that rare labels count."""
    share = np.bincount(label.ravel(), minlength=len(LABELS)).astype(float)
    share[UNLABELLED] = 0
    share /= share.sum()
    weight = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-4)), 0)
    return torch.from_numpy((weight / (weight * share).sum()).astype(np.float32))
