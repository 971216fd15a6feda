"""`boresight train`: train a network of calibration or of perception, without any ground truth."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jobs.extras import require
from jobs.terminal.logging import logger
from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.config import FleetConfig, load_fleet, validated
from pipeline.core.errors import ConfigError
from pipeline.learn.train.settings import TrainConfig, load_train_config
from pipeline.store.partitions import Lake

if TYPE_CHECKING:
    from pipeline.learn.train.loop import TrainResult
    from pipeline.learn.train.run import TrainRequest

__all__ = ["parse_duration", "train"]

_NOT_VALIDATED = "do not use it, it was not validated: set val_fraction, prepare, and train in a new folder"
_UNIT_S = {"s": 1.0, "m": 60.0, "h": 3600.0}


def train(  # options of the command
    *,
    data: str,
    out: Path,
    task: Literal["calibration", "lidar_semantics", "radar_drivable"] = "calibration",
    fleet: Path | None = None,
    config: Path | None = None,
    architecture: Literal["matching", "concat"] | None = None,
    pairs: Literal["joint", "camera_lidar", "camera_radar", "lidar_radar"] | None = None,
    steps: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    frames_per_day: int | None = None,
    rows: int | None = None,
    columns: int | None = None,
    budget: str | None = None,
    seed: int | None = None,
    start_from: Path | None = None,
    time_limit: str | None = None,
    device: Literal["auto", "cpu", "cuda"] | None = None,
    threads: int | None = None,
) -> int:
    """Train a calibration network, or with --task a network of perception; or continue the run in OUT.

    Calibration learns from the table training (written by `boresight prepare`). Several processes:
    `torchrun --nproc-per-node N $(which boresight) train ...`.

    Lidar semantics learn from the camera, the radar's drivable area from the lidar. The day's prior projects the
    labels; for a lidar the day's accepted calibration does, if there is one. Every fifth vehicle-day is held out (at
    least one); of a single vehicle-day, its last fifth. A finished run has TASK.onnx and TASK.toml. Name the .toml in
    fleet.toml: `semantics = { source = "onnx", segmenter = "lidar_semantics.toml" }` under the rig's lidar,
    or `drivable = { source = "onnx", model = "radar_drivable.toml" }` under its radar.

    Args:
        data: folder of the tables; with table training, or with observations (of a lidar also frames and, if
            available, calibrations).
        out: folder of the run: last.pt, metrics.jsonl, the model; of calibration also best.pt, events, train.json.
        task: calibration, or a network of perception; options of another task are refused.
        fleet: fleet.toml, for perception; sets the source of each vehicle's prior.
        config: train.toml of calibration; options here override it.
        architecture: of calibration: explicit matching, or the paper's concatenation.
        pairs: of calibration: one network for all three pairs, or for one pair.
        steps: total number of steps; of calibration instead of the configuration's epochs, lidar 400, radar 600.
        batch_size: frames per process and step; sweeps (4) or scans (8) per step.
        learning_rate: initial learning rate.
        frames_per_day: of perception: maximum number of samples per vehicle-day, evenly spaced; 30 or 100.
        rows: rows of the lidar's range image, over its field of view; 48.
        columns: columns of the lidar's range image, over 360 deg; 1024.
        budget: of calibration: duration of the whole run, over all calls, as in 25m; the learning rate decays over it.
        seed: random seed.
        start_from: of calibration: finished run, or exported model.onnx, with the first weights of a new run.
        time_limit: stop this call after this duration, as in 9m; the same command continues from its checkpoint.
        device: of calibration: cpu, cuda, or the best one available (auto).
        threads: of perception: CPU threads; 1.
    """
    require("train")
    limit = None if time_limit is None else parse_duration(time_limit, "time-limit")
    options = {
        "architecture": architecture, "pairs": pairs, "steps": steps, "batch_size": batch_size,
        "learning_rate": learning_rate, "frames_per_day": frames_per_day, "rows": rows, "columns": columns,
        "budget_minutes": None if budget is None else parse_duration(budget, "budget") / 60, "seed": seed,
    }  # fmt: skip
    given = {name: value for name, value in options.items() if value is not None}
    if task == "calibration":
        from pipeline.learn.train.run import TrainRequest

        _refuse(task, fleet=fleet, threads=threads)
        request = TrainRequest(data, out, device or "auto", limit, start_from)
        return _run(request, load_train_config(config, given))
    _refuse(task, config=config, start_from=start_from, device=device)
    if fleet is None:
        raise ConfigError("command line", "fleet", f"{task} needs --fleet, for each vehicle's prior")
    return _train_perception(task, load_fleet(fleet), Lake.at(data), out, given, limit, threads or 1)


def _refuse(task: str, **options: object) -> None:
    """Raise ConfigError for an option of another task."""
    if given := [name for name, value in options.items() if value is not None]:
        raise ConfigError("command line", ", ".join(given), f"is not an option of {task}")


def _train_perception(
    task: str,
    fleet: FleetConfig,
    lake: Lake,
    out: Path,
    given: dict[str, Any],
    limit: float | None,
    threads: int,
) -> int:
    """Train a network of perception and export it when it is done."""
    import torch

    from pipeline.learn.perception_training import TASKS
    from pipeline.learn.perception_training.trainer import export_model, train_network

    chosen = TASKS[task]
    config = validated(chosen.config, given, f"options of {task}")
    with progress_reporter("samples"):
        samples = chosen.samples(fleet, lake, config)
    torch.set_num_threads(threads)
    with progress_reporter(f"train {out.name}") as progress:
        network, result = train_network(chosen, samples, out, config, limit, progress)
    outputs: list[Path] = []
    if result.status == "done":
        card = {"data": samples.numbers, "training": config.model_dump(), "held_out": result.report}
        outputs = [export_model(chosen, network, samples.train, out, card)]
    return _tell(result, out, "scores", task=task, outputs=outputs, **samples.numbers)


def _run(request: TrainRequest, settings: TrainConfig) -> int:
    """Train in this process, or as one process of torchrun; prints the summary once."""
    from pipeline.learn.prepare.inventory import doubts
    from pipeline.learn.train.run import train as run

    if os.environ.get("RANK", "0") != "0":  # a process of torchrun: only the first one prints
        return 128 + signal if (signal := run(request, settings).signal) else 0
    for doubt in doubts(Lake.at(request.data), referenced=settings.needs_reference):
        logger().warning(doubt, data=request.data)
    with progress_reporter(f"train {request.out.name}") as progress:
        result = run(request, settings, progress)
    again = f"give the same command again: {result.step} of {result.steps} steps are done"
    then = f"boresight export onnx --run {request.out} --out model.onnx" if result.status == "done" else again
    steps = [then] if (request.out / "best.pt").exists() else [_NOT_VALIDATED]
    return _tell(result, request.out, next_steps=steps)


def _tell(result: TrainResult, out: Path, report: str = "report", **more: object) -> int:
    """Print the result of a training call with its last report and `more`; returns the exit code."""
    fields = asdict(result) | more
    fields[report] = fields.pop("report")
    print_summary("train", fields.pop("status"), out=out, **fields)
    return 128 + result.signal if result.signal else 0


def parse_duration(text: str, option: str) -> float:
    """Parse "90s", "25m", "1.5h" or a number to seconds; ConfigError if not above 0."""
    number, unit = (text[:-1], text[-1]) if text and text[-1] in _UNIT_S else (text, "s")
    try:
        seconds = float(number) * _UNIT_S[unit]
    except ValueError as err:
        raise ConfigError("command line", option, f"{text!r} is no duration like 90s, 25m or 1h") from err
    if not 0 < seconds < float("inf"):
        raise ConfigError("command line", option, f"{text!r}: must be above 0")
    return seconds
