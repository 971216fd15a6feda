"""Training: from a lake with table `training` to a run folder with checkpoints, metrics and the resolved config.

Source: paper section 4.5.4 for the recipe.
"""

from __future__ import annotations

import json
import math
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from pipeline.core.errors import ConfigError, ContractError
from pipeline.core.results import Progress, silent
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import TrainingLoader, load_split
from pipeline.learn.network.calibration_network import CalibrationNetwork, build_network, network_of_file
from pipeline.learn.prepare.inventory import require_sides
from pipeline.learn.train.batch_loss import Passes, batch_loss
from pipeline.learn.train.loop import (
    BEST,
    LAST,
    MetricsLog,
    Processes,
    Run,
    TrainResult,
    joined,
    load_checkpoint,
    read_metrics,
    run_loop,
    save_checkpoint,
    stop_signals,
)
from pipeline.learn.train.paper_objective import PaperFrames, with_paper_inputs
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["TrainRequest", "network_of_run", "train"]

_ENDLESS = 10**9  # steps, where time is what ends a run
_VALIDATION_SEED = 977  # the guesses of validation are the same every time


class RunState(Run):
    """One process's part of a run."""

    network: CalibrationNetwork

    def __init__(self, lake: Lake, config: TrainConfig, processes: Processes, loader: TrainingLoader) -> None:
        self.config, self.loader = config, loader
        # Held-out frames as they are: in the mirror a mean answer has the opposite sign.
        unmirrored = config.augment.model_copy(update={"mirror_share": 0.0})
        self.judging = config.model_copy(update={"augment": unmirrored})
        network = build_network(config.network, config.seed).to(processes.device)
        self.paper: PaperFrames | None = None
        if config.loss.definition == "paper":
            with_paper_inputs(network)
            self.paper = PaperFrames(lake)
        self.passes: nn.Module = Passes(network, config.iterations)
        if processes.count > 1:
            # A pair's network uses a part of the encoders only.
            self.passes = DistributedDataParallel(self.passes, find_unused_parameters=True)
        self.best = math.inf
        self.held_out = _held_out(lake, config) if processes.leads else None
        super().__init__(network, config, _steps(config, loader.frames, processes.count), processes)

    @property
    def progress(self) -> float:
        """Share of the run that is done, by time if its end is set by time."""
        if self.config.budget_minutes is not None:
            return self.trained_s / (60 * self.config.budget_minutes)
        return super().progress

    def losses(self) -> dict[str, Tensor]:
        """Losses of the step's batch, from random guesses."""
        batch = next(self.loader).to(self.processes.device)
        generator = _generator(self.config.seed, self.step, self.processes.rank)
        return batch_loss(self.passes, batch, self.config, generator, paper=self.paper)

    def validate(self, folder: Path, log: MetricsLog | None) -> None:
        """At the start and at intervals, judge held-out frames from the same guesses; keep the best weights.

        The start is judged like what follows, so that no checkpoint is kept that is worse than it. Reports by how much
        the mean answer has moved since: training that teaches an answer of its own, or a side, moves it.
        """
        frames, sums = self.held_out, dict[str, float]()
        if frames is None or not (self.step % self.config.validate_every == 0 or self.finished):
            return
        passes, generator = Passes(self.network, self.config.iterations), torch.Generator()
        generator.manual_seed(_VALIDATION_SEED)
        self.network.eval()
        with torch.no_grad():
            for first in range(0, len(frames), 16):
                part = frames[first : first + 16].to(self.processes.device)
                found = batch_loss(passes, part, self.judging, generator, paper=self.paper)
                for name, value in found.items():
                    sums[name] = sums.get(name, 0.0) + float(value) * len(part) / len(frames)
        self.network.train()
        start = next((r for r in read_metrics(folder) if "validation/judged" in r), {})
        for axis in [name.removeprefix("mean_deg/") for name in sums if name.startswith("mean_deg/")]:
            mean = sums[f"mean_deg/{axis}"]
            sums[f"moved_deg/{axis}"] = mean - start.get(f"validation/mean_deg/{axis}", mean)
        if log is not None:
            log.report(self.step, {f"validation/{name}": value for name, value in sums.items()})
        if sums["judged"] < self.best:
            self.best = sums["judged"]
            content = {"network": self.network.state_dict(), "step": self.step, "judged": self.best}
            save_checkpoint(folder / BEST, content | {"config": self.config.model_dump(mode="json")})

    def state(self) -> dict[str, Any]:
        """Content of a checkpoint; every process must call this."""
        everyone = self.processes.gather({"stream": self.loader.state_dict()})
        return super().state() | {"processes": everyone, "best": self.best}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint; raises ConfigError if another number of processes wrote it."""
        if len(state["processes"]) != self.processes.count:
            problem = f"{self.processes.count}, and the run began with {len(state['processes'])}: use as many"
            raise ConfigError("train", "processes", problem)
        super().load(state)
        self.loader.load_state_dict(state["processes"][self.processes.rank]["stream"])
        self.best = float(state["best"])


def network_of_run(folder: Path, *, best: bool = True) -> CalibrationNetwork:
    """Network of a run, on the CPU: the best on validation frames, else the last, else ContractError."""
    path = folder / (BEST if best and (folder / BEST).exists() else LAST)
    if not path.exists():
        raise ContractError(str(folder), f"no run: there is neither {BEST} nor {LAST}")
    state = load_checkpoint(path)
    network = CalibrationNetwork(TrainConfig.model_validate(state["config"]).network)
    network.load_state_dict(state["network"])
    return network.eval()


def _take_weights(network: CalibrationNetwork, start: Path) -> None:
    trained = network_of_file(start) if start.suffix == ".onnx" else network_of_run(start)
    own = asdict(network.config)
    for name, theirs in asdict(trained.config).items():
        ours = own[name]
        # Between stages a camera may be shown classes that it was not shown before, and paint be matched or not.
        may_differ = name == "marks" or (name == "takes_classes" and ours)
        if theirs != ours and not may_differ:
            key, value = ("cell_deg", theirs["cell_deg"]) if name == "grid" else (name, theirs)
            problem = (
                f"{start} has a network of another kind: set {key} = {json.dumps(value)}, or start afresh"
            )
            raise ConfigError("train", key, problem)
    weights, given = network.state_dict(), trained.state_dict()
    for name in weights.keys() & given.keys():
        if weights[name].shape == given[name].shape:
            weights[name] = given[name]
        else:  # zeros for channels that the source network lacks, so that its answers do not change
            weights[name] = torch.zeros_like(weights[name])
            weights[name][:, : given[name].shape[1]] = given[name]
    network.load_state_dict(weights)


def _steps(config: TrainConfig, frames: int, processes: int) -> int:
    if config.steps is not None:
        return config.steps
    if config.budget_minutes is not None:
        return _ENDLESS
    return max(1, math.ceil(config.epochs * frames / (config.batch_size * processes)))


def _held_out(lake: Lake, config: TrainConfig) -> TrainingBatch | None:
    """Frames to validate on; None if the data has none."""
    try:
        return load_split(lake, "val", limit=config.validation_frames, referenced=config.needs_reference)
    except ContractError:
        return None


def _generator(seed: int, step: int, rank: int) -> torch.Generator:
    """Random numbers of one step: they depend on (seed, step, rank) only, so a checkpoint need not hold a state."""
    # Odd multipliers keep neighbouring steps and ranks apart.
    return torch.Generator().manual_seed((seed * 1_000_003 + step * 8_191 + rank * 131) % 2**63)


@dataclass(frozen=True)
class TrainRequest:
    """Options of a training command in addition to the configuration.

    Args:
        data: folder of a lake with table `training`.
        out: folder of the run; an unfinished run in it continues.
        time_limit_s: duration after which this call stops with a checkpoint; None = no limit.
        start: run or exported file with the first weights of a new run; a continued run has its own.
    """

    data: str
    out: Path
    device: str = "auto"
    time_limit_s: float | None = None
    start: Path | None = None


def train(request: TrainRequest, config: TrainConfig, progress: Progress = silent) -> TrainResult:
    """Train, or continue training, until the run is finished, the time is up or a stop signal arrives.

    Raises:
        ConfigError: the run in `out` was begun with another configuration; no such device; `start` has
            another kind of network.
        ContractError: no training data, an empty side, or other data than at the start of the run; no trained
            weights in `start`.
        DivergedError: the loss is not finite or has grown too much; the last checkpoint is from before.
    """
    out, lake = request.out, Lake.at(request.data)
    require_sides(lake)
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        processes = stack.enter_context(joined(request.device))
        stops = stack.enter_context(stop_signals())
        loader = TrainingLoader(
            lake, config.batch_size, seed=config.seed, rank_of=(processes.rank, processes.count),
            referenced=config.needs_reference,
        )  # fmt: skip
        stack.callback(loader.close)
        run = RunState(lake, config, processes, loader)
        if request.start is not None and not (out / LAST).exists():
            _take_weights(run.network, request.start)
        run.resume(out)
        log: MetricsLog | None = None
        if processes.leads:
            (out / "train.json").write_text(json.dumps(config.model_dump(mode="json"), indent=1) + "\n")
            log = stack.enter_context(closing(MetricsLog(out, run.step)))
        return run_loop(run, out, log, stops, request.time_limit_s, progress)
