"""The training loop of perception's networks: resumable, within a time limit, judged on held-out samples.

Everything random in a step comes from (seed, step): a run that was stopped goes on as if it had not been.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.errors import ConfigError, ContractError
from pipeline.learn.train.checkpoints import LAST, load_checkpoint, save_checkpoint
from pipeline.learn.train.metrics import MetricsLog
from pipeline.learn.train.schedule import DivergenceGuard, cosine_rate
from pipeline.learn.train.stop_signals import stop_signals
from pipeline.results import Progress, silent

__all__ = ["Task", "TrainingConfig", "TrainingResult", "hash_of_arrays", "run_training"]

_LAST_RATE = 1e-5  # of the cosine: small enough to stand still, large enough for float32
_DIVERGED = 20.0  # times the smallest smoothed loss so far
_GRADIENT_NORM = 1.0
_SAVE_S = 60.0  # between two checkpoints: what a killed run loses at most


@dataclass(frozen=True)
class TrainingConfig:
    """How to train; a run goes on only with the same.

    Args:
        steps: in all.
        batch_size: samples per step.
        learning_rate: at the start; falls along a cosine.
        width: channels of the network's first layer.
        seed: of everything random.
        report_every: steps between two reports.
    """

    steps: int
    batch_size: int
    learning_rate: float
    width: int
    seed: int = 0
    report_every: int = 25


@dataclass(frozen=True)
class TrainingResult:
    """How a call ended (`done`, `time_limit`, or `stopped` by `signal`), and the scores on held-out samples."""

    status: str
    step: int
    steps: int
    seconds: float
    scores: dict[str, float] = field(default_factory=dict)
    signal: int = 0


@dataclass(frozen=True, eq=False)
class Task:
    """What one network learns.

    Args:
        network: fresh, in training mode.
        data_key: hash of the samples; a run goes on only with the same ones.
        loss: of a batch drawn with the generator given; differentiable, a scalar.
        scores: of the network in evaluation mode on held-out samples, by name.
        metric: name of a score in metrics.jsonl, with {} for the score's own name.
    """

    network: nn.Module
    data_key: str
    loss: Callable[[np.random.Generator], Tensor]
    scores: Callable[[], dict[str, float]]
    metric: str = "held_out/{}"


def run_training(
    task: Task, out: Path, config: TrainingConfig, time_limit_s: float | None, progress: Progress = silent
) -> TrainingResult:
    """Train the task's network, or go on with the run in `out`; leaves last.pt and metrics.jsonl there.

    Raises:
        ContractError: the run was begun on other samples.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is no number or has grown too far.
    """
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(task, torch.optim.Adam(task.network.parameters(), lr=config.learning_rate), config)
    run.resume(out / LAST)
    began = saved = time.monotonic()
    status = "done"
    with stop_signals() as stops, closing(MetricsLog(out, run.step, events=False)) as log:
        while run.step < config.steps:
            if stops or (time_limit_s is not None and time.monotonic() - began >= time_limit_s):
                status = "stopped" if stops else "time_limit"
                break
            if time.monotonic() - saved >= _SAVE_S:
                run.save(out / LAST)
                saved = time.monotonic()
            loss = run.descend()
            if run.step % config.report_every == 0 or run.step == config.steps:
                log.report(run.step, {"loss": loss})
                progress(run.step, config.steps, f"loss {loss:.3f}")
        run.save(out / LAST)
        task.network.eval()
        scores = task.scores()
        log.report(run.step, {task.metric.format(name): value for name, value in scores.items()})
    seconds = time.monotonic() - began
    return TrainingResult(status, run.step, config.steps, seconds, scores, stops[0] if stops else 0)


def hash_of_arrays(*arrays: np.ndarray) -> str:
    """Sixteen hexadecimal digits that say whether samples are the same, bit for bit."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


class _Run:
    """What a step changes, and its checkpoint."""

    def __init__(self, task: Task, optimiser: torch.optim.Adam, config: TrainingConfig) -> None:
        self.task, self.optimiser, self.config = task, optimiser, config
        self.guard, self.step = DivergenceGuard(_DIVERGED), 0

    def descend(self) -> float:
        """One step of Adam; returns the batch's loss."""
        config = self.config
        for group in self.optimiser.param_groups:
            group["lr"] = cosine_rate(self.step / config.steps, config.learning_rate, _LAST_RATE)
        loss = self.task.loss(np.random.default_rng([config.seed, self.step]))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(self.task.network.parameters(), _GRADIENT_NORM)
        value = float(loss.detach())
        self.guard.check(self.step, value, float(norm.detach()))
        self.optimiser.step()
        self.step += 1
        return value

    def save(self, path: Path) -> None:
        """Write the checkpoint."""
        state: dict[str, Any] = {
            "network": self.task.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "guard": self.guard.state_dict(),
            "config": asdict(self.config),
            "data_key": self.task.data_key,
            "step": self.step,
        }
        save_checkpoint(path, state)

    def resume(self, path: Path) -> None:
        """Go on where the checkpoint, if there is one, was written."""
        if not path.exists():
            return
        state = load_checkpoint(path)
        if state["config"] != asdict(self.config):
            problem = f"this run was begun with {state['config']}: take another folder"
            raise ConfigError(str(path), "", problem)
        if state["data_key"] != self.task.data_key:
            raise ContractError(str(path), "this run was begun on other samples: take another folder")
        self.task.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.guard.load_state_dict(state["guard"])
        self.step = int(state["step"])
