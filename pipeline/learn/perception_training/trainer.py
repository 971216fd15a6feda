"""Training of perception's networks, by the loop of all networks, with scores on held-out samples."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.results import Progress, silent
from pipeline.learn.train.checkpoints import LAST, load_checkpoint
from pipeline.learn.train.loop import Run, TrainResult, run_loop
from pipeline.learn.train.metrics import MetricsLog
from pipeline.learn.train.settings import Count, DescentConfig
from pipeline.learn.train.stop_signals import stop_signals

__all__ = ["Task", "TrainingConfig", "hash_of_arrays", "run_training"]


class TrainingConfig(DescentConfig):
    """Training settings; a run continues only with the same ones."""

    steps: Count
    width: Count  # channels of the network's first layer
    final_learning_rate: float = 1e-5  # small enough to stand still, large enough for float32
    gradient_norm: float = 1.0
    log_every: int = 25
    checkpoint_minutes: float = 1.0  # what a killed run loses at most
    diverged_factor: float = 20.0


@dataclass(frozen=True, eq=False)
class Task:
    """Training task of one network.

    Args:
        data_key: hash of the samples; a run continues only with the same ones.
        scores: scores of the network in evaluation mode on held-out samples, by name.
        metric: name of a score in metrics.jsonl, with {} for the score's own name.
    """

    network: nn.Module
    data_key: str
    loss: Callable[[np.random.Generator], Tensor]
    scores: Callable[[], dict[str, float]]
    metric: str = "held_out/{}"


def run_training(
    task: Task, out: Path, config: TrainingConfig, time_limit_s: float | None, progress: Progress = silent
) -> TrainResult:
    """Train the task's network, or continue the run in `out`; leaves last.pt and metrics.jsonl there.

    Raises:
        ContractError: the run was begun on other samples.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is not finite or has grown too much.
    """
    out.mkdir(parents=True, exist_ok=True)
    run = _TaskRun(task, config)
    if (out / LAST).exists():
        run.resume(out / LAST)
    with stop_signals() as stops, closing(MetricsLog(out, run.step, events=False)) as log:
        result = run_loop(run, out, log, stops, time_limit_s, progress)
        task.network.eval()
        scores = task.scores()
        log.report(run.step, {task.metric.format(name): value for name, value in scores.items()})
    return replace(result, report=scores)


def hash_of_arrays(*arrays: np.ndarray) -> str:
    """Sixteen hexadecimal digits that are equal if the arrays are, bit for bit."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


class _TaskRun(Run):
    def __init__(self, task: Task, config: TrainingConfig) -> None:
        super().__init__(task.network, config, config.steps)
        self.task, self.config = task, config

    def losses(self) -> dict[str, Tensor]:
        return {"loss": self.task.loss(np.random.default_rng([self.config.seed, self.step]))}

    def state(self) -> dict[str, Any]:
        return super().state() | {"config": self.config.model_dump(), "data_key": self.task.data_key}

    def resume(self, path: Path) -> None:
        """Continue from a checkpoint."""
        state = load_checkpoint(path)
        if state["config"] != self.config.model_dump():
            problem = f"this run was begun with {state['config']}: take another folder"
            raise ConfigError(str(path), "", problem)
        if state["data_key"] != self.task.data_key:
            raise ContractError(str(path), "this run was begun on other samples: take another folder")
        self.load(state)
