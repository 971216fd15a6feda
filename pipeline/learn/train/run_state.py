"""Everything that a training step changes: begun anew, or read from a run's last checkpoint."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from pipeline.errors import ConfigError, ContractError
from pipeline.learn.network.calibration_network import CalibrationNetwork, build_network
from pipeline.learn.network.exported_weights import network_of_file
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import NetworkConfig
from pipeline.learn.train.acceleration import accelerate
from pipeline.learn.train.batch_loss import Passes
from pipeline.learn.train.batch_stream import BatchStream, batch_stream
from pipeline.learn.train.checkpoints import BEST, LAST, load_checkpoint, save_checkpoint
from pipeline.learn.train.paper_objective import PaperFrames, with_paper_inputs
from pipeline.learn.train.processes import Processes
from pipeline.learn.train.running_mean import DayMeans
from pipeline.learn.train.schedule import DivergenceGuard
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["RunState", "begin_run", "network_of_run"]

_ENDLESS = 10**9  # steps, where time is what ends a run


@dataclass
class RunState:
    """One process's part of a run."""

    config: TrainConfig
    grid: Grid
    network: CalibrationNetwork
    passes: nn.Module
    optimiser: torch.optim.Adam
    stream: BatchStream
    day_means: DayMeans
    guard: DivergenceGuard
    steps: int
    step: int = 0
    trained_s: float = 0.0
    best: float = math.inf
    paper: PaperFrames | None = None

    @property
    def progress(self) -> float:
        """Share of the run that is done, by what its learning rate goes by."""
        if self.config.budget_minutes is not None:
            return self.trained_s / (60 * self.config.budget_minutes)
        return self.step / self.steps

    @property
    def finished(self) -> bool:
        """True when there is nothing left to train."""
        return self.step >= self.steps or self.progress >= 1

    def save(self, folder: Path, processes: Processes) -> None:
        """Write the last checkpoint; every process must call."""
        # "consensus": name of the running day means in checkpoints of format 1.
        own = {"stream": self.stream.state_dict(), "consensus": self.day_means.state_dict()}
        everyone = processes.gather(own)
        if processes.leads:
            state = self.weights() | {
                "optimiser": self.optimiser.state_dict(),
                "processes": everyone,
                "guard": self.guard.state_dict(),
                "step": self.step,
                "trained_s": self.trained_s,
                "best": self.best,
            }
            save_checkpoint(folder / LAST, state)

    def weights(self) -> dict[str, Any]:
        """What inference needs."""
        return {
            "config": self.config.model_dump(mode="json"),
            "grid": asdict(self.grid),
            "network": self.network.state_dict(),
        }

    def load(self, state: dict[str, Any], processes: Processes) -> None:
        """Go on from a checkpoint.

        Raises:
            ConfigError: it was written by another number of processes.
        """
        if len(state["processes"]) != processes.count:
            problem = f"begun by {len(state['processes'])}, now {processes.count}"
            raise ConfigError("train", "processes", f"a run goes on with as many as it was {problem}")
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        own = state["processes"][processes.rank]
        self.stream.load_state_dict(own["stream"])
        self.day_means.load_state_dict(own["consensus"])
        self.guard.load_state_dict(state["guard"])
        self.step, self.trained_s, self.best = (
            int(state["step"]),
            float(state["trained_s"]),
            float(state["best"]),
        )


def begin_run(
    data: str,
    folder: Path,
    config: TrainConfig,
    processes: Processes,
    *,
    compiled: bool,
    resident: bool,
    start: Path | None = None,
) -> RunState:
    """A fresh run, or the one in the folder where its last checkpoint left it.

    Args:
        data: see `TrainRequest`.
        folder: of the run.
        config: a run goes on only with the same.
        processes: this process among those that train together.
        compiled: see `TrainRequest`.
        resident: see `TrainRequest`.
        start: run or exported file whose weights a fresh run begins with; a run that goes on has its own.

    Raises:
        ConfigError: the folder's run has another configuration; `start` has another kind of network.
        ContractError: no training data, or other data than the run began with; nothing trained in `start`.
    """
    stream = batch_stream(data, config, processes, resident=resident)
    try:
        grid = Grid(config.cell_deg)
        network = build_network(_network_config(config, grid), config.seed).to(processes.device)
        by_paper = config.loss.definition == "paper"
        if by_paper:
            with_paper_inputs(network)
        accelerate(network, half=processes.device.type == "cuda", compiled=compiled)
        passes: nn.Module = Passes(network, config.iterations)
        if processes.count > 1:
            # A pair's network uses a part of the encoders only.
            passes = DistributedDataParallel(passes, find_unused_parameters=True)
        run = RunState(
            config,
            grid,
            network,
            passes,
            torch.optim.Adam(network.parameters(), lr=config.learning_rate, betas=config.adam_betas),
            stream,
            DayMeans(),
            DivergenceGuard(config.diverged_factor),
            _steps(config, stream.frames, processes.count),
            paper=PaperFrames(Lake.at(data)) if by_paper else None,
        )
        if (folder / LAST).exists():
            state = load_checkpoint(folder / LAST, processes.device)
            _same_config(folder, state["config"], config)
            run.load(state, processes)
        elif start is not None:
            _take_weights(network, start)
    except BaseException:
        stream.close()
        raise
    return run


def network_of_run(folder: Path, *, best: bool = True) -> CalibrationNetwork:
    """The trained network of a run, on the CPU, for inference: the best on validation frames, else the last.

    Raises:
        ContractError: no readable checkpoint.
    """
    path = folder / (BEST if best and (folder / BEST).exists() else LAST)
    if not path.exists():
        raise ContractError(str(folder), f"no run: there is neither {BEST} nor {LAST}")
    state = load_checkpoint(path)
    config = TrainConfig.model_validate(state["config"])
    network = CalibrationNetwork(_network_config(config, Grid(**state["grid"])))
    network.load_state_dict(state["network"])
    return network.eval()


def _take_weights(network: CalibrationNetwork, start: Path) -> None:
    trained = network_of_file(start) if start.suffix == ".onnx" else network_of_run(start)
    # What the camera is shown, and whether paint is matched, may change between stages.
    shown = replace(trained.config, takes_classes=network.config.takes_classes, marks=network.config.marks)
    if shown != network.config:
        problem = f"{start} has a network of another kind, {trained.config}, not {network.config}"
        raise ConfigError("train", "start-from", problem)
    network.load_state_dict(_widened(trained.state_dict(), network.state_dict()))


def _widened(trained: dict[str, Tensor], fresh: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights with zeros for channels that the network they come from has not: it answers as before."""
    found = {}
    for name, value in fresh.items():
        weight = trained.get(name, value)
        if weight.shape != value.shape:
            weight = torch.zeros_like(value)
            weight[:, : trained[name].shape[1]] = trained[name]
        found[name] = weight
    return found


def _network_config(config: TrainConfig, grid: Grid) -> NetworkConfig:
    return NetworkConfig(
        config.architecture,
        config.pairs,
        grid,
        config.width,
        config.hidden,
        config.takes_classes,
        config.marks,
    )


def _steps(config: TrainConfig, frames: int, processes: int) -> int:
    if config.steps is not None:
        return config.steps
    if config.budget_minutes is not None:
        return _ENDLESS
    return max(1, math.ceil(config.epochs * frames / (config.batch_size * processes)))


def _same_config(folder: Path, begun: dict[str, Any], config: TrainConfig) -> None:
    now = config.model_dump(mode="json")
    begun = TrainConfig.model_validate(begun).model_dump(mode="json")  # as this release names it
    other = sorted(k for k in begun.keys() | now.keys() if begun.get(k) != now.get(k))
    if other:
        problem = (
            f"the run in this folder was begun with another {other[0]}: use a new folder, or the old value"
        )
        raise ConfigError(str(folder), other[0], problem)
