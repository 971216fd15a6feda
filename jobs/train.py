"""`boresight train`: train a network from training data, without any ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jobs.extras import needs

if TYPE_CHECKING:
    from pipeline.learn.train.loop import TrainResult
    from pipeline.learn.train.run import TrainRequest
    from pipeline.learn.train.settings import TrainConfig

__all__ = ["parse_duration", "report_training", "train"]

_UNIT_S = {"s": 1.0, "m": 60.0, "h": 3600.0}


@needs("train")
def train(  # options of the command
    *,
    data: str,
    out: Path,
    config: Path | None = None,
    architecture: Literal["matching", "concat"] | None = None,
    pairs: Literal["joint", "camera_lidar", "camera_radar", "lidar_radar"] | None = None,
    steps: int | None = None,
    batch_size: int | None = None,
    budget: str | None = None,
    seed: int | None = None,
    start_from: Path | None = None,
    time_limit: str | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    compiled: bool = False,
) -> int:
    """Train on the table training (from `boresight prepare`), or continue the run in OUT.

    Several processes: `torchrun --nproc-per-node N $(which boresight) train ...`.

    Args:
        data: folder of the tables, with table training.
        out: folder of the run: last.pt, best.pt, metrics.jsonl, events, train.json.
        config: train.toml; options here override it.
        architecture: explicit matching, or the paper's concatenation.
        pairs: one network for all three pairs, or for one pair.
        steps: total number of steps, instead of the configuration's epochs.
        batch_size: frames per process and step.
        budget: duration of the whole run, as in 25m; the learning rate decays over it.
        seed: random seed.
        start_from: finished run, or exported model.onnx, with the initial weights of a new run, for
            fine-tuning.
        time_limit: stop after this duration, as in 9m, with a checkpoint to continue from.
        device: cpu, cuda, or the best one available.
        compiled: compile the encoders (takes minutes at the start, faster afterwards).
    """
    from pipeline.learn.train.run import TrainRequest
    from pipeline.learn.train.settings import load_train_config

    minutes = None if budget is None else parse_duration(budget, "budget") / 60
    options = {
        "architecture": architecture,
        "pairs": pairs,
        "steps": steps,
        "batch_size": batch_size,
        "budget_minutes": minutes,
        "seed": seed,
    }
    settings = load_train_config(config, options)
    limit = None if time_limit is None else parse_duration(time_limit, "time-limit")
    request = TrainRequest(data, out, device, limit, compiled, start_from)
    return _run(request, settings)


def _run(request: TrainRequest, settings: TrainConfig) -> int:
    """Train in this process, or as one process of torchrun; prints the summary once."""
    import os

    from jobs.terminal.summary import progress_reporter
    from pipeline.learn.train.run import train as run

    if os.environ.get("RANK", "0") != "0":  # a process of torchrun: only the first one prints
        result = run(request, settings)
        return 128 + result.signal if result.signal else 0
    with progress_reporter(f"train {request.out.name}") as progress:
        result = run(request, settings, progress)
    return report_training("train", result, request.out)


def report_training(
    command: str, result: TrainResult, out: Path, report: str = "report", **more: object
) -> int:
    """Print the result of a training call with its last report and `more`; returns the exit code."""
    from dataclasses import asdict

    from jobs.terminal.summary import print_summary

    fields = asdict(result) | more
    fields[report] = fields.pop("report")
    print_summary(command, fields.pop("status"), out=out, **fields)
    return 128 + result.signal if result.signal else 0


def parse_duration(text: str, option: str) -> float:
    """Parse "90s", "25m", "1.5h" or a number to seconds; ConfigError if not above 0."""
    from pipeline.core.errors import ConfigError

    number, unit = (text[:-1], text[-1]) if text and text[-1] in _UNIT_S else (text, "s")
    try:
        seconds = float(number) * _UNIT_S[unit]
    except ValueError as err:
        raise ConfigError(
            "command line", option, f"{text!r} is not a duration, as in 90s, 25m or 1h"
        ) from err
    if not 0 < seconds < float("inf"):
        raise ConfigError("command line", option, f"{text!r}: must be above 0")
    return seconds
