"""Training on a Ray cluster: the same function in every worker, as by torchrun. Needs the extra [train-ray]."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from pipeline.errors import BoresightError, ConfigError, ContractError, MissingExtraError
from pipeline.learn.train.loop import TrainResult
from pipeline.learn.train.run import TrainRequest, train
from pipeline.learn.train.settings import TrainConfig

__all__ = ["train_on_ray"]

_RESULT = "boresight_result.pt"


def train_on_ray(request: TrainRequest, config: TrainConfig, workers: int) -> TrainResult:
    """Train with Ray Train's workers; `out` and `data` must be where every worker can reach them.

    Raises:
        ConfigError: `workers` is below 1.
        MissingExtraError: Ray's trainer is not installed.
        BoresightError: an error that `train` raised in a worker.
        ContractError: a worker failed otherwise, or was lost.
    """
    if workers < 1:
        raise ConfigError("command line", "ray-workers", f"{workers} is below 1")
    try:
        from ray.train import RunConfig, ScalingConfig, TrainingFailedError  # noqa: PLC0415 - an extra
        from ray.train.torch import TorchTrainer  # noqa: PLC0415
    except ImportError as err:
        raise MissingExtraError("train-ray", "ray.train") from err
    # Workers run in other folders, where relative paths differ.
    request = replace(request, out=request.out.absolute(), data=_absolute(request.data))
    request.out.mkdir(parents=True, exist_ok=True)
    (request.out / _RESULT).unlink(missing_ok=True)
    settings = {"request": asdict(request), "config": config.model_dump(mode="json")}
    on_gpu = request.device == "cuda" or (request.device == "auto" and torch.cuda.is_available())
    trainer = TorchTrainer(
        _work,
        train_loop_config=settings,
        scaling_config=ScalingConfig(num_workers=workers, use_gpu=on_gpu),
        # Ray's own notes lie with the run, not in the home folder.
        run_config=RunConfig(name="ray", storage_path=str(request.out)),
    )
    try:
        trainer.fit()
    except TrainingFailedError as err:
        raise _cause(request.out, err) from err
    return _read_result(request.out)


def _absolute(data: str) -> str:
    return data if "://" in data else str(Path(data).absolute())


def _cause(out: Path, error: Exception) -> BoresightError:
    """The worker's own error if Ray reports it; otherwise Ray's message."""
    failures = getattr(error, "worker_failures", None) or {}
    for found in [*failures.values(), error]:
        cause: BaseException | None = found
        while cause is not None:
            if isinstance(cause, BoresightError):
                return cause
            cause = getattr(cause, "cause", None) or cause.__cause__
    return ContractError(str(out), f"training on Ray failed: {error}")


def _work(settings: dict[str, Any]) -> None:
    """One worker: Ray has joined the process group; set the rank that `joined` reads from the environment."""
    from ray.train import get_context  # noqa: PLC0415 - an extra

    context = get_context()
    os.environ["RANK"] = str(context.get_world_rank())
    os.environ["WORLD_SIZE"] = str(context.get_world_size())
    os.environ["LOCAL_RANK"] = str(context.get_local_rank())
    request = TrainRequest(**settings["request"])
    result = train(request, TrainConfig.model_validate(settings["config"]))
    if context.get_world_rank() == 0:
        from pipeline.learn.train.checkpoints import save_checkpoint  # noqa: PLC0415 - Ray pickles this function

        save_checkpoint(request.out / _RESULT, {"result": asdict(result)})


def _read_result(folder: Path) -> TrainResult:
    from pipeline.learn.train.checkpoints import load_checkpoint  # noqa: PLC0415

    return TrainResult(**load_checkpoint(folder / _RESULT)["result"])
