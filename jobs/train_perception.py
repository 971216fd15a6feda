"""`boresight train-perception`: train a network of perception; another sensor is the teacher."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jobs.extras import needs

__all__ = ["train_perception"]


@needs("train")
def train_perception(  # options of the command
    task: Literal["lidar_semantics", "radar_drivable"],
    /,
    *,
    fleet: Path,
    lake: str,
    out: Path,
    steps: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    seed: int | None = None,
    frames_per_day: int | None = None,
    rows: int | None = None,
    columns: int | None = None,
    time_limit: str | None = None,
    threads: int = 1,
) -> int:
    """Train lidar semantics from the camera, or the radar's drivable area from the lidar.

    A finished run has TASK.onnx and TASK.toml; the same command continues an unfinished one. Set the .toml in
    fleet.toml: `semantics = { source = "onnx", segmenter = "lidar_semantics.toml" }` under the rig's lidar, or
    `drivable = { source = "onnx", model = "radar_drivable.toml" }` under its radar. Labels come through the
    day's prior; those of the lidar through the day's accepted calibration if there is one. Every fifth
    vehicle-day is held out (at least one); of a single vehicle-day, its last fifth.

    Args:
        task: lidar_semantics or radar_drivable.
        fleet: fleet.toml; sets the source of each vehicle's prior.
        lake: folder of the tables, with observations; of a lidar also frames and, if available, calibrations.
        out: folder of the run: last.pt, metrics.jsonl, the model with its manifest and card.
        steps: total number of steps; lidar 400, radar 600.
        batch_size: sweeps (4) or scans (8) per step.
        learning_rate: initial learning rate, 4e-3 or 3e-3; decays to 1e-5.
        seed: random seed.
        frames_per_day: maximum number of samples per vehicle-day, evenly spaced; 30 or 100.
        rows: rows of the lidar's range image, over its field of view; 48.
        columns: columns of the lidar's range image, over 360 deg; 1024.
        time_limit: stop after this duration, as in 9m, with a checkpoint to continue from.
        threads: CPU threads.
    """
    import torch

    from jobs.terminal.summary import progress_reporter
    from jobs.train import parse_duration, report_training
    from pipeline.core.config import load_fleet, validated
    from pipeline.learn.perception_training import TASKS
    from pipeline.learn.perception_training.trainer import export_model, train_network
    from pipeline.store.partitions import Lake

    chosen, limit = TASKS[task], None if time_limit is None else parse_duration(time_limit, "time-limit")
    options = {
        "steps": steps,
        "batch_size": batch_size,
        "learning_rate": learning_rate,
        "seed": seed,
        "frames_per_day": frames_per_day,
        "rows": rows,
        "columns": columns,
    }
    given = {name: value for name, value in options.items() if value is not None}
    config = validated(chosen.config, given, f"options of {task}")
    with progress_reporter("samples"):
        samples = chosen.samples(load_fleet(fleet), Lake.at(lake), config)
    torch.set_num_threads(threads)
    with progress_reporter(f"train {out.name}") as progress:
        network, result = train_network(chosen, samples, out, config, limit, progress)
    outputs: list[Path] = []
    if result.status == "done":
        card = {"data": samples.numbers, "training": config.model_dump(), "held_out": result.report}
        outputs = [export_model(chosen, network, samples.train, out, card)]
    return report_training("train-perception", result, out, "scores", outputs=outputs, **samples.numbers)
