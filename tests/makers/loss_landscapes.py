"""Where the terms of self-supervision have their minimum over a day's frames, relative to the true extrinsics.

One degree of freedom at a time, the others at the truth. Axes are those of the vehicle in all pairs: x forward, y left,
z up; for camera pairs they turn about the camera. A degree of freedom counts as determined where the standard error of
the minimum, by the frames' own scatter, is below a third of what is asked of it (0.15 deg, 5 cm).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from pipeline.core.config import load_fleet
from pipeline.learn.batches.batch import TrainingBatch, collate
from pipeline.learn.prepare.survey import reference_of, usable_records
from pipeline.learn.sample.frame_sample import About, make_row
from pipeline.learn.train.frame_objective import FrameObjective, weighted
from pipeline.learn.train.settings import LossConfig
from pipeline.rig.day_prior import read_prior
from pipeline.rig.se3 import exp_so3
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, observations_of

PAIRS = ("camera_lidar", "camera_radar", "lidar_radar")
TOLERANCE = np.array([0.15] * 3 + [0.05] * 3)  # deg, m
# Offsets of one degree of freedom, in tolerances.
STEPS = np.array([-8.0, -4, -2, -1, 0, 1, 2, 4, 8])
_CAMERA_AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # of vehicle axes


@dataclass(frozen=True)
class Minimum:
    """Minimum of a mean over frames along one degree of freedom [deg or m], and its standard error (inf = none)."""

    offset: float
    error: float

    def determined(self, tolerance: float) -> bool:
        """Whether the frames say where the minimum is."""
        return self.error < tolerance / 3


def day_batch(
    lake: Lake, partition: Partition, fleet: Path, told: Mapping[str, float] | None = None
) -> TrainingBatch:
    """Rows of a perceived day as one batch, by its record of `joint` where it has a usable one, or by true clocks."""
    config = load_fleet(fleet)
    observations = list(observations_of(lake, partition))
    logged = {f.frame_index: f for f in list(frames_of(lake, partition))}
    records = usable_records(lake, partition, config.rig_of(partition.vehicle).one_of_each("training"))
    reference = reference_of(records, read_prior(observations, config, partition.vehicle))
    if told is not None:
        reference = replace(
            reference, **{f"{dt}_s": told[f"{dt}_s"] for dt in ("dt_camera_lidar", "dt_lidar_radar")}
        )
    about = About(partition.vehicle, partition.day, "rig", "train", "place", "unknown")
    return collate(
        [make_row(logged[o.frame_index], o, reference, about, config.prepare) for o in observations]
    )


def moved(T: np.ndarray, pair: str, dof: int, offset: float) -> np.ndarray:
    """The pose turned [deg] or shifted [m] along an axis of the vehicle."""
    axis = np.eye(3)[dof % 3]
    if pair != "lidar_radar":
        axis = _CAMERA_AXES @ axis
    T = T.copy()
    if dof < 3:
        T[:3, :3] = exp_so3(np.radians(offset) * axis) @ T[:3, :3]
    else:
        T[:3, 3] += offset * axis
    return T


def minima(
    batch: TrainingBatch, truth: dict[str, np.ndarray], weights: LossConfig, dofs: Sequence[int] = range(6)
) -> dict[str, list[Minimum]]:
    """By pair, of the weighted sum of its terms: the minimum along degrees of freedom."""
    objective = [FrameObjective(batch[slice(i, i + 8)]) for i in range(0, len(batch), 8)]
    found: dict[str, list[Minimum]] = {pair: [] for pair in PAIRS}
    for dof in dofs:
        offsets = STEPS * TOLERANCE[dof]
        poses = {pair: np.stack([moved(truth[pair], pair, dof, o) for o in offsets]) for pair in PAIRS}
        for pair, own in found.items():
            own.append(minimum(offsets, _curve(objective, poses, weights, pair)))
    return found


def minimum(offsets: np.ndarray, curve: np.ndarray) -> Minimum:
    """Minimum of the mean of curves (offsets x frames); at the border it is none."""
    fine = np.linspace(offsets[0], offsets[-1], 1601)
    lowest = fine[np.argmin(CubicSpline(offsets, curve.mean(1))(fine))]
    if lowest in (fine[0], fine[-1]) or np.ptp(curve.mean(1)) < 1e-9:
        return Minimum(float("nan"), float("inf"))
    # Slope of each frame's own curve about the minimum, over +- two tolerances, and the mean's second difference.
    reach = 2 * (offsets[-1] / STEPS[-1])
    low, middle, high = (CubicSpline(offsets, curve)(lowest + s * reach) for s in (-1, 0, 1))
    slopes, bend = (high - low) / (2 * reach), float((high - 2 * middle + low).mean()) / reach**2
    if bend <= 0:
        return Minimum(float(lowest), float("inf"))
    return Minimum(float(lowest), float(slopes.std() / np.sqrt(curve.shape[1]) / bend))


def _curve(
    objective: Sequence[FrameObjective], poses: dict[str, np.ndarray], weights: LossConfig, pair: str
) -> np.ndarray:
    """Weighted sum of a pair's terms at poses of all pairs: poses x frames."""
    T = [torch.tensor(poses[name], dtype=torch.float32) for name in PAIRS]
    with torch.no_grad():
        parts = [
            torch.stack(
                [
                    weighted(
                        part.terms(*(t.expand(len(part.centres_rad), 4, 4) for t in at), (pair,)), weights
                    )
                    for at in zip(*T, strict=True)
                ]
            )
            for part in objective
        ]
    return torch.cat(parts, 1).numpy()
