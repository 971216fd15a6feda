"""Training on a Ray cluster: the same function in every worker, as torchrun would start it. Needs the extra [ray]."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError
from pipeline.learn.settings import TrainConfig
from pipeline.learn.training import TrainRequest, TrainResult, train

__all__ = ["train_on_ray"]

_RESULT = "boresight_result.pt"


def train_on_ray(request: TrainRequest, config: TrainConfig, workers: int) -> TrainResult:
    """Train with Ray Train's workers; `out` and `data` must be where every worker can reach them.

    Raises:
        ConfigError: Ray is not installed, or `workers` is below 1.
    """
    if workers < 1:
        raise ConfigError("command line", "ray-workers", f"{workers} is below 1")
    try:
        from ray.train import ScalingConfig  # noqa: PLC0415 - an extra
        from ray.train.torch import TorchTrainer  # noqa: PLC0415
    except ImportError as err:
        raise ConfigError(
            "command line", "ray-workers", "needs the extra: pip install 'boresight[ray]'"
        ) from err
    settings = {"request": asdict(request), "config": config.model_dump(mode="json")}
    scaling = ScalingConfig(num_workers=workers, use_gpu=request.device == "cuda")
    TorchTrainer(_work, train_loop_config=settings, scaling_config=scaling).fit()
    return _read_result(request.out)


def _work(settings: dict[str, Any]) -> None:
    """One worker: Ray has joined the process group; tell ours who we are."""
    from ray.train import get_context  # noqa: PLC0415 - an extra

    context = get_context()
    os.environ["RANK"] = str(context.get_world_rank())
    os.environ["WORLD_SIZE"] = str(context.get_world_size())
    os.environ["LOCAL_RANK"] = str(context.get_local_rank())
    request = TrainRequest(**settings["request"])
    result = train(request, TrainConfig.model_validate(settings["config"]))
    if context.get_world_rank() == 0:
        from pipeline.learn.checkpoints import save_checkpoint  # noqa: PLC0415 - Ray pickles this function

        save_checkpoint(request.out / _RESULT, {"result": asdict(result)})


def _read_result(folder: Path) -> TrainResult:
    from pipeline.learn.checkpoints import load_checkpoint  # noqa: PLC0415

    return TrainResult(**load_checkpoint(folder / _RESULT)["result"])
