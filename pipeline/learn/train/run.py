"""Training: from a lake with table `training` to a run folder with checkpoints, metrics and the resolved config.

A run can be stopped at any moment and goes on where its last checkpoint was; on one CPU thread it then gives the same
weights, bit for bit, as one that was never stopped. Everything random in a step comes from (seed, step, rank).

Source: paper section 4.5.4 for the recipe.
"""

from __future__ import annotations

import json
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import torch

from pipeline.errors import ContractError
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import load_split
from pipeline.learn.train.batch_loss import Passes, batch_loss
from pipeline.learn.train.batch_stream import frames_at
from pipeline.learn.train.checkpoints import BEST, save_checkpoint
from pipeline.learn.train.metrics import MetricsLog
from pipeline.learn.train.processes import Processes, joined
from pipeline.learn.train.run_state import RunState, begin_run
from pipeline.learn.train.running_mean import DayMeans
from pipeline.learn.train.schedule import cosine_rate
from pipeline.learn.train.settings import TrainConfig
from pipeline.learn.train.stop_signals import stop_signals
from pipeline.results import Progress, silent
from pipeline.store.partitions import Lake

__all__ = ["TrainRequest", "TrainResult", "train"]

_VALIDATION_SEED = 977  # the guesses of validation are the same every time


@dataclass(frozen=True)
class TrainRequest:
    """What a command asks for beside the configuration.

    Args:
        data: folder of a lake with table `training`.
        out: folder of the run; an unfinished run in it goes on.
        device: cpu, cuda or auto.
        time_limit_s: stop with a checkpoint after so long in this call; None = no limit.
        compiled: compile the encoders.
        resident: hold the whole split on the device.
        start: run whose best weights a fresh run begins with, for fine-tuning on other data.
    """

    data: str
    out: Path
    device: str = "auto"
    time_limit_s: float | None = None
    compiled: bool = False
    resident: bool = False
    start: Path | None = None


@dataclass(frozen=True)
class TrainResult:
    """How a call ended: `done`, `time_limit` or `stopped` (by `signal`), where, and the last report."""

    status: str
    step: int
    steps: int
    samples: int
    seconds: float
    report: dict[str, float]
    signal: int = 0


def train(request: TrainRequest, config: TrainConfig, progress: Progress = silent) -> TrainResult:
    """Train, or go on training, until the run is finished, the time is up or a signal asks to stop.

    Raises:
        ConfigError: the run in `out` was begun with another configuration; no such device.
        ContractError: no training data, or other data than the run began with.
        DivergedError: the loss is no number or has grown too far; the last checkpoint is from before.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        processes = stack.enter_context(joined(request.device))
        stops = stack.enter_context(stop_signals())
        run = begin_run(
            request.data,
            request.out,
            config,
            processes,
            compiled=request.compiled,
            resident=request.resident,
            start=request.start,
        )
        stack.callback(run.stream.close)
        log: MetricsLog | None = None
        if processes.leads:
            (request.out / "train.json").write_text(
                json.dumps(config.model_dump(mode="json"), indent=1) + "\n"
            )
            log = stack.enter_context(closing(MetricsLog(request.out, run.step)))
        return _loop(request, run, processes, log, stops, progress)


def _loop(
    request: TrainRequest,
    run: RunState,
    processes: Processes,
    log: MetricsLog | None,
    stops: list[int],
    progress: Progress,
) -> TrainResult:
    config, began = run.config, time.monotonic()
    validation = _validation_frames(request.data, config) if processes.leads else None
    saved = reported = tick = began
    first_step, reported_step = run.step, run.step
    report: dict[str, float] = {}
    while not run.finished:
        now = time.monotonic()
        run.trained_s, tick = run.trained_s + now - tick, now
        late = request.time_limit_s is not None and now - began >= request.time_limit_s
        stop, save = processes.any([bool(stops) or late, now - saved >= 60 * config.checkpoint_minutes])
        if stop:
            break
        if save:
            run.save(request.out, processes)
            saved = time.monotonic()
        values = _step(run, processes)
        if run.step % config.log_every == 0 or run.finished:
            report = {name: float(value) for name, value in values.items()}
            now = time.monotonic()
            frames = (run.step - reported_step) * config.batch_size * processes.count
            report["samples_per_s"] = frames / max(now - reported, 1e-9)
            reported, reported_step = now, run.step
            if log is not None:
                log.report(run.step, report)
            progress(run.step, min(run.steps, run.step + 10**6), f"loss {report['loss']:.3f}")
        if validation is not None and (run.step % config.validate_every == 0 or run.finished):
            _validate(run, validation, request.out, log)
    run.save(request.out, processes)
    status = "done" if run.finished else ("stopped" if stops else "time_limit")
    samples = (run.step - first_step) * config.batch_size * processes.count
    seconds = time.monotonic() - began
    return TrainResult(status, run.step, run.steps, samples, seconds, report, stops[0] if stops else 0)


def _step(run: RunState, processes: Processes) -> dict[str, torch.Tensor]:
    """One step of Adam; returns what to report."""
    config = run.config
    rate = cosine_rate(run.progress, config.learning_rate, config.final_learning_rate)
    for group in run.optimiser.param_groups:
        group["lr"] = rate
    batch = run.stream.batch(run.step)
    matched = (run.step + 1) % config.matched_every == 0
    found = batch_loss(
        run.passes,
        batch,
        config,
        run.day_means,
        _generator(config.seed, run.step, processes.rank),
        run.network,
        matched=matched,
        paper=run.paper,
    )
    run.optimiser.zero_grad(set_to_none=True)
    found.loss.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(run.network.parameters(), config.gradient_norm)
    means = processes.mean(torch.stack([found.report["loss"].float(), norm.detach().float()]))
    loss, gradient = means.tolist()
    if matched:  # losses of the encoders alone are of another size
        run.guard.check(run.step, loss, gradient)
    run.optimiser.step()
    run.step += 1
    return found.report | {"loss": means[0], "gradient_norm": means[1], "learning_rate": torch.tensor(rate)}


def _validate(run: RunState, frames: TrainingBatch, folder: Path, log: MetricsLog | None) -> None:
    """Report the losses of held-out frames from the same guesses every time; keep the best weights."""
    passes = Passes(run.network, run.config.iterations)
    generator, day_means = torch.Generator().manual_seed(_VALIDATION_SEED), DayMeans()
    device = next(run.network.parameters()).device
    sums: dict[str, float] = {}
    run.network.eval()
    with torch.no_grad():
        for first in range(0, len(frames), 16):
            part = frames_at(frames, torch.arange(first, min(first + 16, len(frames)))).to(device)
            found = batch_loss(passes, part, run.config, day_means, generator, run.network, paper=run.paper)
            for name, value in found.report.items():
                sums[name] = sums.get(name, 0.0) + float(value) * len(part) / len(frames)
    run.network.train()
    if log is not None:
        log.report(run.step, {f"validation/{name}": value for name, value in sums.items()})
    if sums["alignment"] < run.best:
        run.best = sums["alignment"]
        save_checkpoint(folder / BEST, run.weights() | {"step": run.step, "alignment": run.best})


def _validation_frames(data: str, config: TrainConfig) -> TrainingBatch | None:
    """Held-out frames; None where the data has none."""
    try:
        return load_split(Lake.at(data), "val", limit=config.validation_frames)
    except ContractError:
        return None


def _generator(seed: int, step: int, rank: int) -> torch.Generator:
    """Random numbers of one step: they depend on (seed, step, rank) only, so a checkpoint need not hold a state."""
    # Odd multipliers keep neighbouring steps and ranks apart.
    return torch.Generator().manual_seed((seed * 1_000_003 + step * 8_191 + rank * 131) % 2**63)
