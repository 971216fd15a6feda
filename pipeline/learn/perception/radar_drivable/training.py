"""Train the network for the radar's drivable area: resumable, within a time limit, judged on held-out days.

Everything random in a step comes from (seed, step): a run that was stopped goes on as if it had not been.
"""

from __future__ import annotations

import hashlib
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch.nn import functional

from pipeline.errors import ConfigError, ContractError
from pipeline.geometry.radar_grid import cell_centres, sector_mask, sector_of
from pipeline.learn.perception.radar_drivable.network import DrivableNetwork, build_drivable_network
from pipeline.learn.perception.radar_drivable.samples import FREE, UNKNOWN, DrivableSamples
from pipeline.learn.train.checkpoints import LAST, load_checkpoint, save_checkpoint
from pipeline.learn.train.metrics import MetricsLog
from pipeline.learn.train.schedule import DivergenceGuard, cosine_rate
from pipeline.learn.train.stop_signals import stop_signals
from pipeline.results import Progress, silent

__all__ = [
    "DrivableTrainResult",
    "DrivableTraining",
    "area_iou",
    "held_out_iou",
    "probabilities",
    "train_drivable",
]

_LAST_RATE, _DIVERGED, _GRADIENT_NORM, _SAVE_S = 1e-5, 20.0, 1.0, 60.0


@dataclass(frozen=True)
class DrivableTraining:
    """How to train; a run goes on only with the same."""

    steps: int = 600
    batch_size: int = 8
    learning_rate: float = 3e-3
    width: int = 24
    seed: int = 0
    report_every: int = 25


@dataclass(frozen=True)
class DrivableTrainResult:
    """How a call ended (`done`, `time_limit`, `stopped` by `signal`), and held-out IoU of who answered how."""

    status: str
    step: int
    steps: int
    seconds: float
    iou: dict[str, float]
    signal: int = 0


def train_drivable(
    train: DrivableSamples,
    held_out: DrivableSamples,
    out: Path,
    config: DrivableTraining,
    time_limit_s: float | None = None,
    progress: Progress = silent,
) -> tuple[DrivableNetwork, DrivableTrainResult]:
    """Train, or go on with the run in `out`, until it is finished, the time is up or a signal says stop.

    Raises:
        ContractError: no samples on one side, or others than the run began with.
        ConfigError: the run was begun with another configuration.
        DivergedError: the loss is no number or has grown too far.
    """
    if not len(train) or not len(held_out):
        raise ContractError(
            str(out), f"{len(train)} samples to learn from and {len(held_out)} held out: both are needed"
        )
    out.mkdir(parents=True, exist_ok=True)
    network = build_drivable_network(config.width, config.seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    guard, key = DivergenceGuard(_DIVERGED), _key(train)
    began = saved = time.monotonic()
    step = _resume(out / LAST, network, optimiser, guard, config, key)
    status = "done"
    with stop_signals() as told, closing(MetricsLog(out, step, events=False)) as log:
        while step < config.steps:
            if told or (time_limit_s is not None and time.monotonic() - began >= time_limit_s):
                status = "stopped" if told else "time_limit"
                break
            if time.monotonic() - saved >= _SAVE_S:
                _save(out, network, optimiser, guard, config, key, step)
                saved = time.monotonic()
            loss = _descend(network, optimiser, guard, train, config, step)
            step += 1
            if step % config.report_every == 0 or step == config.steps:
                log.report(step, {"loss": loss})
                progress(step, config.steps, f"loss {loss:.3f}")
        _save(out, network, optimiser, guard, config, key, step)
        network.eval()
        iou = held_out_iou(network, train, held_out)
        log.report(step, {f"held_out/iou_{name}": value for name, value in iou.items()})
    seconds = time.monotonic() - began
    return network, DrivableTrainResult(status, step, config.steps, seconds, iou, told[0] if told else 0)


def held_out_iou(
    network: DrivableNetwork, train: DrivableSamples, held_out: DrivableSamples
) -> dict[str, float]:
    """IoU with the lidar's label on held-out samples: the network's sectors, the geometric ones, and one guess for all.

    The guess is the best that ignores the scan: each cell as it mostly is in the samples to learn from.
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


def _descend(
    network: DrivableNetwork,
    optimiser: torch.optim.Adam,
    guard: DivergenceGuard,
    train: DrivableSamples,
    config: DrivableTraining,
    step: int,
) -> float:
    rng = np.random.default_rng([config.seed, step])
    batch = train.at(rng.integers(0, len(train), config.batch_size))
    mirror = (
        rng.random(config.batch_size) < 0.5
    )  # a world seen in a mirror is a world, a shifted prior is undone
    features = np.where(mirror[:, None, None, None], batch.features[:, :, ::-1], batch.features)
    label = np.where(mirror[:, None, None], batch.label[:, ::-1], batch.label)
    for group in optimiser.param_groups:
        group["lr"] = cosine_rate(step / config.steps, config.learning_rate, _LAST_RATE)
    logits = network(torch.from_numpy(features).float())
    weight = torch.from_numpy((label != UNKNOWN) * np.sqrt(cell_centres()[1])).float()
    target = torch.from_numpy(label == FREE).float()
    losses = functional.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum")
    loss = losses / weight.sum().clamp(min=1)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), _GRADIENT_NORM)
    value = float(loss.detach())
    guard.check(step, value, float(norm.detach()))
    optimiser.step()
    return value


def _save(
    out: Path,
    network: DrivableNetwork,
    optimiser: torch.optim.Adam,
    guard: DivergenceGuard,
    config: DrivableTraining,
    key: str,
    step: int,
) -> None:
    state = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
    plain = {"guard": guard.state_dict(), "config": asdict(config), "data_key": key, "step": step}
    save_checkpoint(out / LAST, state | plain)


def _resume(
    path: Path,
    network: DrivableNetwork,
    optimiser: torch.optim.Adam,
    guard: DivergenceGuard,
    config: DrivableTraining,
    key: str,
) -> int:
    """Step to go on from: 0 where there is no checkpoint."""
    if not path.exists():
        return 0
    state = load_checkpoint(path)
    if state["config"] != asdict(config):
        raise ConfigError(str(path), "", f"this run was begun with {state['config']}: take another folder")
    if state["data_key"] != key:
        raise ContractError(str(path), "this run was begun on other samples: take another folder")
    network.load_state_dict(state["network"])
    optimiser.load_state_dict(state["optimiser"])
    guard.load_state_dict(state["guard"])
    return int(state["step"])


def _key(samples: DrivableSamples) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(samples.features).data)
    digest.update(np.ascontiguousarray(samples.label).data)
    return digest.hexdigest()[:16]
