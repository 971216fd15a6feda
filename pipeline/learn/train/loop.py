"""The training loop of every network, in one process or several: resumable, within a time limit, to be stopped.

A run can be stopped at any moment and continues at its last checkpoint. On one CPU thread it then gives the
same weights, bit for bit, as a run without a stop: all randomness of a step comes from (seed, step, rank).
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import torch
from torch import Tensor, distributed, nn

from pipeline.core.errors import BoresightError, ConfigError, ContractError
from pipeline.core.results import Progress
from pipeline.learn.train.settings import DescentConfig

__all__ = [
    "ALONE", "BEST", "LAST", "DivergedError", "DivergenceGuard", "MetricsLog", "Processes", "Run",
    "TrainResult", "joined", "load_checkpoint", "read_metrics", "run_loop", "save_checkpoint", "stop_signals",
]  # fmt: skip


@dataclass(frozen=True)
class Processes:
    """This process among those that train together."""

    rank: int
    count: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """True for the one that writes."""
        return self.rank == 0

    def any(self, flags: list[bool]) -> list[bool]:
        """Each flag: true on all as soon as it is true on one, so that all stop after the same step."""
        if self.count == 1:
            return flags
        told = torch.tensor([float(f) for f in flags], device=self.device)
        distributed.all_reduce(told, op=distributed.ReduceOp.MAX)
        return [value > 0 for value in told.tolist()]

    def gather(self, value: Any) -> list[Any]:
        """Everyone's value, by rank; every process must call."""
        if self.count == 1:
            return [value]
        everyone: list[Any] = [None] * self.count
        distributed.all_gather_object(everyone, value)
        return everyone

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Mean over the processes."""
        if self.count > 1:
            distributed.all_reduce(values)
            values = values / self.count
        return values


ALONE = Processes(0, 1, torch.device("cpu"))


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Join the process group that torchrun described in the environment, or train alone.

    `device` is cpu, cuda (the GPU of this process) or auto; ConfigError if there is none.
    """
    rank, count = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    chosen = _device(device, int(os.environ.get("LOCAL_RANK", "0")))
    if count > 1:
        distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Processes(rank, count, chosen)
    finally:
        if count > 1:
            distributed.destroy_process_group()


def _device(name: str, local_rank: int) -> torch.device:
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise ConfigError("train", "device", "no CUDA device here; use cpu")
    device = torch.device("cuda", local_rank)
    torch.cuda.set_device(device)
    return device


LAST, BEST = "last.pt", "best.pt"
_FORMAT = 1


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write atomically; `state` holds tensors, numbers, strings, lists and dicts only."""
    aside = path.with_suffix(".part")
    with aside.open("wb") as stream:
        torch.save({"format": _FORMAT} | state, stream)
        stream.flush()
        os.fsync(stream.fileno())
    aside.replace(path)


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without running code in it; raises ContractError if it has another format."""
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    except Exception as err:  # torch raises whatever its unpickler met
        raise ContractError(str(path), f"no checkpoint that can be read: {err}") from err
    if state.get("format") != _FORMAT:
        raise ContractError(str(path), f"checkpoint of format {state.get('format')}, not {_FORMAT}")
    return state


class MetricsLog:
    """Appends reports of a run; after a resume, lines beyond the checkpoint are dropped first, so none is doubled.

    Args:
        from_step: reports of later steps are dropped.
        events: whether to write TensorBoard events as well, where TensorBoard is installed.
    """

    def __init__(self, folder: Path, from_step: int, *, events: bool = True) -> None:
        self._path = folder / "metrics.jsonl"
        kept = [r for r in read_metrics(folder) if r["step"] <= from_step]
        self._path.write_text("".join(json.dumps(r) + "\n" for r in kept))
        self._file: TextIO = self._path.open("a")
        self._events = _writer(folder / "events", from_step) if events else None

    def report(self, step: int, values: dict[str, float]) -> None:
        """One report; values that are not finite become null."""
        plain = {k: v if math.isfinite(v) else None for k, v in values.items()}
        self._file.write(json.dumps({"step": step} | plain) + "\n")
        self._file.flush()
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Finish both files; `contextlib.closing` calls it."""
        self._file.close()
        if self._events is not None:
            self._events.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All complete lines of a run's reports, oldest first."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().split("\n") if path.exists() else []
    return [json.loads(line) for line in lines[:-1]]  # a killed run may leave its last line unfinished


def _writer(folder: Path, from_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - needs the extra [train]
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=from_step + 1)


_PATIENCE = 20  # reports before any is judged
_SMOOTHING = 0.05  # of the loss: about the last twenty reports count


class DivergedError(BoresightError):
    """Training that diverges: `step` and the loss."""

    def __init__(self, step: int, reason: str) -> None:
        self.step, self.reason = step, reason
        super().__init__(f"training diverged at step {step}: {reason}")


@dataclass
class DivergenceGuard:
    """Raises if the loss is not finite, or `factor` times its smallest smoothed value; the rest is its state."""

    factor: float
    smooth: float | None = None
    least: float = math.inf
    seen: int = 0

    def check(self, step: int, loss: float, gradient_norm: float) -> None:
        """Check the loss of one step."""
        for name, value in (("loss", loss), ("gradient's norm", gradient_norm)):
            if not math.isfinite(value):
                raise DivergedError(step, f"the {name} is {value}")
        self.seen += 1
        self.smooth = loss if self.smooth is None else self.smooth + _SMOOTHING * (loss - self.smooth)
        self.least = min(self.least, self.smooth)
        # Likelihood terms may take the sum below zero: a loss near zero has no useful multiple.
        limit = self.factor * max(abs(self.least), 1.0)
        if self.seen > _PATIENCE and self.smooth > limit:
            told = f"is more than {self.factor:g} times its minimum of {self.least:.3g}"
            raise DivergedError(step, f"the smoothed loss {self.smooth:.3g} {told}")


@dataclass(frozen=True)
class TrainResult:
    """How a call ended (`done`, `time_limit`, or `stopped` by `signal`), where, and the last report."""

    status: str
    step: int
    steps: int
    samples: int
    seconds: float
    report: dict[str, float] = field(default_factory=dict)
    signal: int = 0


class Run(ABC):
    """State that a step changes; the network is in training mode."""

    def __init__(
        self, network: nn.Module, config: DescentConfig, steps: int, processes: Processes = ALONE
    ) -> None:
        self.network, self.descent, self.steps, self.processes = network, config, steps, processes
        self.optimiser = torch.optim.Adam(
            network.parameters(), lr=config.learning_rate, betas=config.adam_betas
        )
        self.guard = DivergenceGuard(config.diverged_factor)
        self.step, self.trained_s = 0, 0.0

    @property
    def progress(self) -> float:
        """Share of the run that is done, which the learning rate follows."""
        return self.step / self.steps

    @property
    def finished(self) -> bool:
        """True if the run has no steps left."""
        return self.step >= self.steps or self.progress >= 1

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """The next step's `loss`, differentiable, and further values to report."""

    def validate(self, folder: Path, log: MetricsLog | None) -> None:  # noqa: B027 - not every run validates
        """Called at the start and after every step."""

    def state(self) -> dict[str, Any]:
        """Content of a checkpoint; every process must call this."""
        return {
            "network": self.network.state_dict(), "optimiser": self.optimiser.state_dict(),
            "guard": asdict(self.guard), "step": self.step, "trained_s": self.trained_s,
            "config": self.descent.model_dump(mode="json"),
        }  # fmt: skip

    def resume(self, folder: Path) -> None:
        """Continue at the folder's last checkpoint, if there is one; ConfigError if its run had other settings."""
        if not (folder / LAST).exists():
            return
        state = load_checkpoint(folder / LAST, self.processes.device)
        # By way of JSON, for checkpoints up to 0.13 hold tuples.
        begun, now = json.loads(json.dumps(state["config"])), self.descent.model_dump(mode="json")
        other = sorted(k for k in begun.keys() | now.keys() if begun.get(k) != now.get(k))
        if other:
            problem = f"the run in this folder was begun with another {other[0]}: use a new folder, or the old value"
            raise ConfigError(str(folder), other[0], problem)
        self.load(state)

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint."""
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.guard = replace(self.guard, **state["guard"])
        self.step, self.trained_s = int(state["step"]), float(state["trained_s"])

    def save(self, folder: Path) -> None:
        """Write the last checkpoint; every process must call."""
        state = self.state()
        if self.processes.leads:
            save_checkpoint(folder / LAST, state)

    def descend(self) -> dict[str, Tensor]:
        """One step of Adam; returns values to report."""
        config = self.descent
        cosine, last = math.cos(math.pi * min(self.progress, 1.0)), config.final_learning_rate
        rate = last + 0.5 * (config.learning_rate - last) * (1 + cosine)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        found = self.losses()
        self.optimiser.zero_grad(set_to_none=True)
        found["loss"].backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_norm)
        means = self.processes.mean(torch.stack([found["loss"].detach().float(), norm.detach().float()]))
        self.guard.check(self.step, *means.tolist())
        self.optimiser.step()
        self.step += 1
        return found | {"loss": means[0], "gradient_norm": means[1], "learning_rate": torch.tensor(rate)}


def run_loop(
    run: Run, folder: Path, log: MetricsLog | None, stops: list[int], time_limit_s: float | None,
    progress: Progress,
) -> TrainResult:  # fmt: skip
    """Train until the run is finished, the time is up or a signal stops it; leaves last.pt in the folder.

    Args:
        log: of the process that leads; None in the others.
        stops: signals received, see `stop_signals`.
        time_limit_s: of this call; None = no limit.

    Raises:
        DivergedError: the loss is no number or has grown too far; the last checkpoint is from before.
    """
    config, processes, began = run.descent, run.processes, time.monotonic()
    saved = reported = tick = began
    first_step = reported_step = run.step
    report: dict[str, float] = {}

    def samples_since(step: int) -> int:
        return (run.step - step) * config.batch_size * processes.count

    if run.step == 0:
        run.validate(folder, log)
    while not run.finished:
        now = time.monotonic()
        run.trained_s, tick = run.trained_s + now - tick, now
        late = time_limit_s is not None and now - began >= time_limit_s
        stop, save = processes.any([bool(stops) or late, now - saved >= 60 * config.checkpoint_minutes])
        if stop:
            break
        if save:
            run.save(folder)
            saved = time.monotonic()
        values = run.descend()
        if run.step % config.log_every == 0 or run.finished:
            now = time.monotonic()
            report = {name: float(value) for name, value in values.items()}
            report["samples_per_s"] = samples_since(reported_step) / max(now - reported, 1e-9)
            reported, reported_step = now, run.step
            if log is not None:
                log.report(run.step, report)
            steps = round(run.step / max(run.progress, 1e-9))  # of a budget of time: at the pace so far
            progress(run.step, max(run.step, steps), f"loss {report['loss']:.3f}")
        run.validate(folder, log)
    run.save(folder)
    status = "done" if run.finished else ("stopped" if stops else "time_limit")
    seconds, ended_by = time.monotonic() - began, stops[0] if stops else 0
    return TrainResult(status, run.step, run.steps, samples_since(first_step), seconds, report, ended_by)


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collect SIGTERM and SIGINT instead of ending the process in the middle of a step.

    Yields a list of the signals so far. It stays empty outside the main thread, which alone receives signals.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
