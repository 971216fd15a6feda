"""Train the network for the radar's drivable area; scores compare it with the lidar's labels of held-out days."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pipeline.core.errors import ContractError
from pipeline.core.results import Progress, silent
from pipeline.core.rows import take_rows
from pipeline.learn.perception_training.radar_drivable.network import DrivableNetwork, build_drivable_network
from pipeline.learn.perception_training.radar_drivable.samples import FREE, UNKNOWN, DrivableSamples
from pipeline.learn.perception_training.trainer import (
    Task,
    TrainingConfig,
    hash_of_arrays,
    run_training,
)
from pipeline.learn.train.loop import TrainResult
from pipeline.rig.radar_grid import cell_centres, sector_mask, sector_of

__all__ = ["DrivableTraining", "area_iou", "held_out_iou", "probabilities", "train_drivable"]


class DrivableTraining(TrainingConfig):
    """Defaults that suit some hundred scans."""

    steps: int = 600
    batch_size: int = 8
    learning_rate: float = 3e-3
    width: int = 24


def train_drivable(
    train: DrivableSamples,
    held_out: DrivableSamples,
    out: Path,
    config: DrivableTraining,
    time_limit_s: float | None = None,
    progress: Progress = silent,
) -> tuple[DrivableNetwork, TrainResult]:
    """Train, or continue the run in `out`, until it is finished, the time is up or a signal stops it.

    Returns the scores of `held_out_iou`.

    Raises:
        ContractError: no samples on one side, or others than the run began with.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is not finite or has grown too far.
    """
    if not len(train) or not len(held_out):
        problem = f"{len(train)} samples to learn from and {len(held_out)} held out: both are needed"
        raise ContractError(str(out), problem)
    network = build_drivable_network(config.width, config.seed)
    task = Task(
        network,
        hash_of_arrays(train.features, train.label),
        lambda rng: _loss(network, take_rows(train, rng.integers(0, len(train), config.batch_size)), rng),
        lambda: held_out_iou(network, train, held_out),
        "held_out/iou_{}",
    )
    return network, run_training(task, out, config, time_limit_s, progress)


def held_out_iou(
    network: DrivableNetwork, train: DrivableSamples, held_out: DrivableSamples
) -> dict[str, float]:
    """IoU with the lidar's labels on held-out samples, of the network and two simple answers.

    These are the geometric fallback, and the best constant answer: the most frequent label of each cell.
    """
    free, known = (train.label == FREE).sum(axis=0), (train.label != UNKNOWN).sum(axis=0)
    guess = np.broadcast_to(2 * free > known, held_out.label.shape)
    sectors = np.stack([sector_mask(*sector_of(p)) for p in probabilities(network, held_out)])
    return {
        "network": area_iou(sectors, held_out.label),
        "geometric": area_iou(held_out.geometric, held_out.label),
        "constant": area_iou(guess, held_out.label),
    }


def area_iou(answer: np.ndarray, label: np.ndarray) -> float:
    """IoU of areas [m2] over all samples; cells without label do not count."""
    area = np.broadcast_to(cell_centres()[1], label.shape) * (label != UNKNOWN)
    free = label == FREE
    return float((area * (answer & free)).sum() / max((area * (answer | free)).sum(), 1e-9))


def probabilities(network: DrivableNetwork, samples: DrivableSamples) -> Float[np.ndarray, "N A R"]:
    """How likely each cell is drivable."""
    with torch.no_grad():
        parts = [
            torch.sigmoid(network(torch.from_numpy(samples.features[i : i + 16]).float()))
            for i in range(0, len(samples), 16)
        ]
    return torch.cat(parts).numpy()


def _loss(network: DrivableNetwork, batch: DrivableSamples, rng: np.random.Generator) -> Float[Tensor, ""]:
    """Binary cross-entropy per labelled cell, by the root of the cell's area; half of the scans are mirrored."""
    # A mirrored world is equally valid, and cancels the shift of a wrong prior to one side.
    mirror = rng.random(len(batch)) < 0.5
    features = np.where(mirror[:, None, None, None], batch.features[:, :, ::-1], batch.features)
    label = np.where(mirror[:, None, None], batch.label[:, ::-1], batch.label)
    logits = network(torch.from_numpy(features).float())
    weight = torch.from_numpy((label != UNKNOWN) * np.sqrt(cell_centres()[1])).float()
    target = torch.from_numpy(label == FREE).float()
    losses = functional.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum")
    return losses / weight.sum().clamp(min=1)
