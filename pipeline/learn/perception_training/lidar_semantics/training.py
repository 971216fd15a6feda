"""Train the range-image network; scores compare it with projected labels of held-out days."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from pipeline.core.errors import ContractError
from pipeline.core.results import Progress, silent
from pipeline.core.rows import take_rows
from pipeline.learn.perception_training.lidar_semantics.labels import (
    GROUND,
    KIND_OF_LABEL,
    KINDS,
    LABELS,
    UNLABELLED,
)
from pipeline.learn.perception_training.lidar_semantics.network import SweepNetwork, build_sweep_network
from pipeline.learn.perception_training.lidar_semantics.samples import Normal, SweepImages, normal_of
from pipeline.learn.perception_training.trainer import (
    Task,
    TrainingConfig,
    hash_of_arrays,
    run_training,
)
from pipeline.learn.train.loop import TrainResult
from pipeline.rig.range_image import EMPTY

__all__ = ["SweepTraining", "held_out_scores", "kind_scores", "train_sweeps"]

_BRIGHTNESS = 0.2  # remission of lidars of one make differs by as much


class SweepTraining(TrainingConfig):
    """Defaults that suit some hundred sweeps."""

    steps: int = 400
    batch_size: int = 4
    learning_rate: float = 4e-3
    width: int = 16


def train_sweeps(
    train: SweepImages,
    held_out: SweepImages,
    out: Path,
    config: SweepTraining,
    time_limit_s: float | None = None,
    progress: Progress = silent,
) -> tuple[SweepNetwork, TrainResult]:
    """Train, or continue the run in `out`, until it is finished, the time is up or a stop signal arrives.

    Raises:
        ContractError: no labels on one side, or other samples than the run began with.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is not finite or has grown too much.
    """
    for side, name in ((train, "to learn from"), (held_out, "held out")):
        if not np.any(side.label != UNLABELLED):
            problem = f"no labelled points in the {len(side)} sweeps {name}: both are needed"
            raise ContractError(str(out), problem)
    network = build_sweep_network(config.width, config.seed)
    normal, weight = normal_of(train), _weights(train.label)
    task = Task(
        network,
        hash_of_arrays(train.channels, train.label),
        lambda rng: _loss(
            network, take_rows(train, rng.integers(0, len(train), config.batch_size)), rng, normal, weight
        ),
        lambda: held_out_scores(network, held_out, normal),
    )
    return network, run_training(task, out, config, time_limit_s, progress)


def held_out_scores(network: SweepNetwork, images: SweepImages, normal: Normal) -> dict[str, float]:
    """Share of labelled pixels with the right kind, and IoU of ground and of each labelled kind."""
    with torch.no_grad():
        found = np.concatenate(
            [
                network(torch.from_numpy(normal.apply(images.channels[i : i + 8]))).argmax(1).numpy()
                for i in range(0, len(images), 8)
            ]
        )
    known = images.label != UNLABELLED
    return kind_scores(KIND_OF_LABEL[found[known]], KIND_OF_LABEL[images.label[known]])


def kind_scores(found: UInt8[np.ndarray, " N"], wanted: UInt8[np.ndarray, " N"]) -> dict[str, float]:
    """Accuracy of kinds, IoU of ground and of each kind that occurs in the labels."""
    scores = {"accuracy": float(np.mean(found == wanted))}
    sets = {"ground": GROUND} | {KINDS[k]: (k,) for k in range(1, len(KINDS))}
    for name, kinds in sets.items():
        a, b = np.isin(found, kinds), np.isin(wanted, kinds)
        if b.any():
            scores[f"iou_{name}"] = float(np.sum(a & b) / np.sum(a | b))
    return scores


def _loss(
    network: SweepNetwork, batch: SweepImages, rng: np.random.Generator, normal: Normal, weight: Tensor
) -> Float[Tensor, ""]:
    """Weighted cross-entropy of the varied batch over its labelled pixels."""
    channels, label = _varied(batch, rng)
    target = torch.from_numpy(label.astype(np.int64))
    logits = network(torch.from_numpy(normal.apply(channels)))
    total = functional.cross_entropy(logits, target, weight, ignore_index=UNLABELLED, reduction="sum")
    return total / weight[target].sum().clamp(min=1e-6)


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
