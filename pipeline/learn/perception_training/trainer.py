"""Train a network of perception from another sensor, score it on held-out days, and export it."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import onnx
import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ContractError
from pipeline.core.results import Progress, silent
from pipeline.core.rows import join_rows, take_rows
from pipeline.learn.export.onnx_file import trace_to_onnx, write_card
from pipeline.learn.train.loop import MetricsLog, Run, TrainResult, run_loop, stop_signals
from pipeline.learn.train.settings import Count, DescentConfig
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import perceived_days
from schemas.versions import CODE_VERSION

__all__ = [
    "Labelled", "Samples", "Task", "TrainingConfig", "export_model", "split_days", "train_network",
    "vehicle_days",
]  # fmt: skip

_HELD_OUT_EVERY = 5  # vehicle-days; the second one already, so that two are enough


class TrainingConfig(DescentConfig):
    """Training settings; a run continues only with the same ones."""

    steps: Count
    width: Count  # channels of the network's first layer
    frames_per_day: Count  # at most, evenly spaced
    final_learning_rate: float = 1e-5  # small enough to stand still, large enough for float32
    gradient_norm: float = 1.0
    log_every: int = 25
    checkpoint_minutes: float = 1.0  # what a killed run loses at most
    diverged_factor: float = 20.0


@dataclass(frozen=True, eq=False)
class Labelled:
    """A table of samples: arrays with one entry per sample, labels among them."""

    label: np.ndarray  # first axis: samples

    def __len__(self) -> int:
        return len(self.label)


R = TypeVar("R", bound=Labelled)


@dataclass(frozen=True, eq=False)
class Samples(Generic[R]):
    """Samples to learn from and held-out ones, and their numbers for the card."""

    train: R
    held_out: R
    numbers: dict[str, int]


class Task(ABC, Generic[R]):
    """A network that perception uses, taught by some samples; `name` is of the command and of the model's files."""

    name: ClassVar[str]
    purpose: ClassVar[str]
    limits: ClassVar[tuple[str, ...]]
    config: ClassVar[type[TrainingConfig]]
    unlabelled: ClassVar[int]

    def __init__(self, train: R) -> None:
        self.train = train

    @staticmethod
    @abstractmethod
    def samples(fleet: FleetConfig, lake: Lake, config: Any) -> Samples[R]:
        """Samples of all days of a lake; ContractError if there are no days."""

    @staticmethod
    @abstractmethod
    def network(width: int) -> nn.Module:
        """Fresh weights."""

    @abstractmethod
    def loss(self, network: nn.Module, batch: R, rng: np.random.Generator) -> Float[Tensor, ""]:
        """Loss of a batch, differentiable."""

    @abstractmethod
    def scores(self, network: nn.Module, held_out: R) -> dict[str, float]:
        """Scores of the network in evaluation mode, by name."""

    @abstractmethod
    def graph(self, network: nn.Module) -> tuple[nn.Module, Tensor, tuple[str, str], str]:
        """What is exported: module, example, names of input and output, and the model's .toml after path and sha256."""


def vehicle_days(fleet: FleetConfig, lake: Lake) -> list[Partition]:
    """Perceived vehicle-days of the fleet; raises ContractError if there are none."""
    days = [p for p in perceived_days(lake) if fleet.knows(p.vehicle)]
    if not days:
        problem = "no vehicle-days with observations of vehicles in fleet.toml: run `boresight perceive`"
        raise ContractError(str(lake.root), problem)
    return days


def split_days(days: Sequence[Partition], samples_of: Callable[[Partition], R]) -> Samples[R]:
    """Samples of all days, every fifth day held out; of a single day, the first 0.7 against the last 0.2."""
    parts = [samples_of(day) for day in days]
    held = [part for i, part in enumerate(parts) if i % _HELD_OUT_EVERY == 1]
    if held:
        train = join_rows([part for i, part in enumerate(parts) if i % _HELD_OUT_EVERY != 1])
        held_out = join_rows(held)
    else:
        # Neighbouring scans are alike: a tenth between the two sides belongs to neither.
        rows, total = np.arange(len(parts[0])), len(parts[0])
        train = take_rows(parts[0], rows[: int(0.7 * total)])
        held_out = take_rows(parts[0], rows[int(0.8 * total) :])
    numbers = {"vehicle_days": len(days), "samples": len(train), "held_out_samples": len(held_out)}
    return Samples(train, held_out, numbers)


def train_network(
    task: type[Task[R]], samples: Samples[R], out: Path, config: TrainingConfig,
    time_limit_s: float | None = None, progress: Progress = silent,
) -> tuple[nn.Module, TrainResult]:  # fmt: skip
    """Train, or continue the run in `out`, until it is finished, the time is up or a signal stops it.

    Leaves last.pt and metrics.jsonl there; the result reports the scores on held-out samples.

    Raises:
        ContractError: no labels on one side, or other samples than the run began with.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is not finite or has grown too much.
    """
    for side, name in ((samples.train, "for training"), (samples.held_out, "held out")):
        if not np.any(side.label != task.unlabelled):
            problem = f"no labels in the {len(side)} samples {name}: add days with labels"
            raise ContractError(str(out), problem)
    taught = task(samples.train)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = task.network(config.width)
    out.mkdir(parents=True, exist_ok=True)
    run = _TaskRun(network, taught, config)
    run.resume(out)
    with stop_signals() as stops, closing(MetricsLog(out, run.step, events=False)) as log:
        result = run_loop(run, out, log, stops, time_limit_s, progress)
        scores = taught.scores(network.eval(), samples.held_out)
        log.report(run.step, {f"held_out/{name}": value for name, value in scores.items()})
    return network, replace(result, report=scores)


def export_model(
    task: type[Task[R]], network: nn.Module, train: R, folder: Path, card: dict[str, Any]
) -> Path:
    """Write NAME.onnx, NAME.toml (the manifest), NAME.json and NAME.md (the card); returns the manifest."""
    module, example, names, manifest = task(train).graph(network.eval())
    folder.mkdir(parents=True, exist_ok=True)
    model, unfinished = folder / f"{task.name}.onnx", folder / f"{task.name}.part"
    onnx.checker.check_model(trace_to_onnx(module, (example,), unfinished, names[:1], names[1:]))
    unfinished.replace(model)
    about = {
        "code_version": CODE_VERSION, "parameters": sum(p.numel() for p in network.parameters()),
        "purpose": task.purpose, "command": f"boresight train --task {task.name}",
    }  # fmt: skip
    write_card(model, about | card | {"limits": task.limits})
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    path = folder / f"{task.name}.toml"
    path.write_text(f'path = "{model.name}"\nsha256 = "{digest}"\n{manifest}')
    return path


class _TaskRun(Run):
    def __init__(self, network: nn.Module, task: Task[R], config: TrainingConfig) -> None:
        super().__init__(network, config, config.steps)
        self.task = task
        digest = hashlib.sha256()
        for array in vars(task.train).values():
            if isinstance(array, np.ndarray):
                digest.update(np.ascontiguousarray(array).data)
        self.data_key = digest.hexdigest()[:16]

    def losses(self) -> dict[str, Tensor]:
        rng = np.random.default_rng([self.descent.seed, self.step])
        train = self.task.train
        batch = take_rows(train, rng.integers(0, len(train), self.descent.batch_size))
        return {"loss": self.task.loss(self.network, batch, rng)}

    def state(self) -> dict[str, Any]:
        return super().state() | {"data_key": self.data_key}

    def load(self, state: dict[str, Any]) -> None:
        if state["data_key"] != self.data_key:
            raise ContractError(self.task.name, "this run was begun on other samples: take another folder")
        super().load(state)
