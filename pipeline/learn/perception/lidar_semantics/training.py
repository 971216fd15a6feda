"""Train the range-image network: resumable, within a time limit, judged on held-out days.

Everything random in a step comes from (seed, step): a run that was stopped goes on as if it had not been.
"""

from __future__ import annotations

import hashlib
import time
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8
from torch.nn import functional

from pipeline.errors import ConfigError, ContractError
from pipeline.geometry.range_image import EMPTY
from pipeline.learn.perception.lidar_semantics.labels import GROUND, KIND_OF_LABEL, KINDS, LABELS, UNLABELLED
from pipeline.learn.perception.lidar_semantics.network import SweepNetwork, build_sweep_network
from pipeline.learn.perception.lidar_semantics.samples import SweepImages
from pipeline.learn.train.checkpoints import LAST, load_checkpoint, save_checkpoint
from pipeline.learn.train.metrics import MetricsLog
from pipeline.learn.train.schedule import DivergenceGuard, cosine_rate
from pipeline.learn.train.stop_signals import stop_signals
from pipeline.results import Progress, silent

__all__ = [
    "Normal",
    "SweepTrainResult",
    "SweepTraining",
    "held_out_scores",
    "kind_scores",
    "normal_of",
    "train_sweeps",
]

_LAST_RATE, _DIVERGED, _GRADIENT_NORM, _SAVE_S = 1e-5, 20.0, 1.0, 60.0
_BRIGHTNESS = 0.2  # lidars of one make differ by as much


@dataclass(frozen=True)
class SweepTraining:
    """How to train; a run goes on only with the same."""

    steps: int = 400
    batch_size: int = 4
    learning_rate: float = 4e-3
    width: int = 16
    seed: int = 0
    report_every: int = 25


@dataclass(frozen=True)
class Normal:
    """Mean and deviation of the five channels where points are, as in the manifest."""

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def apply(self, channels: np.ndarray) -> Float32[np.ndarray, "N 5 H W"]:
        """Normalised channels, 0 where no point is."""
        mean, std = (np.array(v, np.float32)[:, None, None] for v in (self.mean, self.std))
        filled = channels[:, :1] != EMPTY
        return np.where(filled, (channels.astype(np.float32) - mean) / std, 0).astype(np.float32)


@dataclass(frozen=True)
class SweepTrainResult:
    """How a call ended (`done`, `time_limit`, `stopped` by `signal`), and scores against held-out labels."""

    status: str
    step: int
    steps: int
    seconds: float
    scores: dict[str, float] = field(default_factory=dict)
    signal: int = 0


@dataclass(eq=False)
class _Run:
    network: SweepNetwork
    optimiser: torch.optim.Adam
    guard: DivergenceGuard
    config: SweepTraining
    key: str
    step: int = 0

    def save(self, out: Path) -> None:
        state: dict[str, Any] = {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        plain = {"guard": self.guard.state_dict(), "config": asdict(self.config), "data_key": self.key}
        save_checkpoint(out / LAST, state | plain | {"step": self.step})

    def resume(self, path: Path) -> None:
        """Go on where the checkpoint, if there is one, was written."""
        if not path.exists():
            return
        state = load_checkpoint(path)
        if state["config"] != asdict(self.config):
            raise ConfigError(
                str(path), "", f"this run was begun with {state['config']}: take another folder"
            )
        if state["data_key"] != self.key:
            raise ContractError(str(path), "this run was begun on other samples: take another folder")
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.guard.load_state_dict(state["guard"])
        self.step = int(state["step"])


def train_sweeps(
    train: SweepImages,
    held_out: SweepImages,
    out: Path,
    config: SweepTraining,
    time_limit_s: float | None = None,
    progress: Progress = silent,
) -> tuple[SweepNetwork, SweepTrainResult]:
    """Train, or go on with the run in `out`, until it is finished, the time is up or a signal says stop.

    Raises:
        ContractError: no labels on one side, or other samples than the run began with.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is no number or has grown too far.
    """
    for side, name in ((train, "to learn from"), (held_out, "held out")):
        if not np.any(side.label != UNLABELLED):
            raise ContractError(
                str(out), f"no labelled points in the {len(side)} sweeps {name}: both are needed"
            )
    out.mkdir(parents=True, exist_ok=True)
    network = build_sweep_network(config.width, config.seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    run = _Run(network, optimiser, DivergenceGuard(_DIVERGED), config, _key(train))
    run.resume(out / LAST)
    normal, weight = normal_of(train), _weights(train.label)
    began = saved = time.monotonic()
    status = "done"
    with stop_signals() as told, closing(MetricsLog(out, run.step, events=False)) as log:
        while run.step < config.steps:
            if told or (time_limit_s is not None and time.monotonic() - began >= time_limit_s):
                status = "stopped" if told else "time_limit"
                break
            if time.monotonic() - saved >= _SAVE_S:
                run.save(out)
                saved = time.monotonic()
            loss = _descend(run, train, normal, weight)
            if run.step % config.report_every == 0 or run.step == config.steps:
                log.report(run.step, {"loss": loss})
                progress(run.step, config.steps, f"loss {loss:.3f}")
        run.save(out)
        network.eval()
        scores = held_out_scores(network, held_out, normal)
        log.report(run.step, {f"held_out/{name}": value for name, value in scores.items()})
    seconds = time.monotonic() - began
    return network, SweepTrainResult(status, run.step, config.steps, seconds, scores, told[0] if told else 0)


def normal_of(images: SweepImages) -> Normal:
    """Statistics of the channels where points are; a channel that never changes is left as it is."""
    values = images.channels.transpose(1, 0, 2, 3)[:, images.channels[:, 0] != EMPTY].astype(np.float64)
    std = values.std(axis=1)
    return Normal(
        tuple(float(v) for v in values.mean(axis=1)), tuple(float(s) if s > 0 else 1.0 for s in std)
    )


def held_out_scores(network: SweepNetwork, images: SweepImages, normal: Normal) -> dict[str, float]:
    """Share of labelled pixels whose kind is right, and IoU of ground and of each kind that the labels know."""
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
    """Accuracy of kinds, IoU of ground and of each kind that is wanted anywhere."""
    scores = {"accuracy": float(np.mean(found == wanted))}
    sets = {"ground": GROUND} | {KINDS[k]: (k,) for k in range(1, len(KINDS))}
    for name, kinds in sets.items():
        a, b = np.isin(found, kinds), np.isin(wanted, kinds)
        if b.any():
            scores[f"iou_{name}"] = float(np.sum(a & b) / np.sum(a | b))
    return scores


def _descend(run: _Run, train: SweepImages, normal: Normal, weight: torch.Tensor) -> float:
    config = run.config
    rng = np.random.default_rng([config.seed, run.step])
    channels, label = _varied(train.at(rng.integers(0, len(train), config.batch_size)), rng)
    for group in run.optimiser.param_groups:
        group["lr"] = cosine_rate(run.step / config.steps, config.learning_rate, _LAST_RATE)
    logits = run.network(torch.from_numpy(normal.apply(channels)))
    loss = functional.cross_entropy(
        logits, torch.from_numpy(label.astype(np.int64)), weight, ignore_index=UNLABELLED, reduction="sum"
    )
    loss = loss / weight[torch.from_numpy(label.astype(np.int64))].sum().clamp(min=1e-6)
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(run.network.parameters(), _GRADIENT_NORM)
    value = float(loss.detach())
    run.guard.check(run.step, value, float(norm.detach()))
    run.optimiser.step()
    run.step += 1
    return value


def _varied(batch: SweepImages, rng: np.random.Generator) -> tuple[np.ndarray, Int[np.ndarray, "N H W"]]:
    """Each sweep turned about the vertical, mirrored or not, brighter or darker.

    Labels come from where the camera looks; turned, they teach what stands on any side.
    """
    channels, label = batch.channels.astype(np.float32), batch.label.astype(np.int64)
    for i in range(len(batch)):
        filled = channels[i, 0] != EMPTY
        if rng.random() < 0.5:
            channels[i], label[i], filled = (
                channels[i, :, :, ::-1].copy(),
                label[i, :, ::-1].copy(),
                filled[:, ::-1],
            )
            channels[i, 2][filled] *= -1
        angle = rng.uniform(-np.pi, np.pi)
        x, y = channels[i, 1][filled], channels[i, 2][filled]
        channels[i, 1][filled] = np.cos(angle) * x - np.sin(angle) * y
        channels[i, 2][filled] = np.sin(angle) * x + np.cos(angle) * y
        channels[i, 4][filled] *= rng.uniform(1 - _BRIGHTNESS, 1 + _BRIGHTNESS)
    return channels, label


def _weights(label: np.ndarray) -> torch.Tensor:
    """Of the labels in the loss: rare ones count more, by the root of their share."""
    share = np.bincount(label.ravel(), minlength=len(LABELS)).astype(float)
    share[UNLABELLED] = 0
    share /= share.sum()
    weight = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 1e-4)), 0)
    return torch.from_numpy((weight / (weight * share).sum()).astype(np.float32))


def _key(images: SweepImages) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(images.channels).data)
    digest.update(np.ascontiguousarray(images.label).data)
    return digest.hexdigest()[:16]
