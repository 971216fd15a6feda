"""`boresight train-radar-drivable`: train a drivable-area network; the lidar is the teacher."""

from __future__ import annotations

from pathlib import Path

from jobs.extras import needs

__all__ = ["train_radar_drivable"]


@needs("train")
def train_radar_drivable(  # options of the command
    *,
    fleet: Path,
    lake: str,
    out: Path,
    steps: int = 600,
    batch_size: int = 8,
    learning_rate: float = 3e-3,
    seed: int = 0,
    frames_per_day: int = 100,
    time_limit: str | None = None,
    threads: int = 1,
) -> int:
    """Train on observations, or continue the run in OUT; a finished run has radar_drivable.onnx and .toml.

    Set the .toml in fleet.toml: `drivable = { source = "onnx", model = "radar_drivable.toml" }` under the
    rig's radar. Every fifth vehicle-day is held out (at least one); of a single vehicle-day, its last fifth.

    Args:
        fleet: fleet.toml; sets the source of each vehicle's prior.
        lake: folder of the tables, with observations.
        out: folder of the run: last.pt, metrics.jsonl, the model with its manifest and card.
        steps: total number of steps.
        batch_size: scans per step.
        learning_rate: initial learning rate; decays to 1e-5.
        seed: random seed.
        frames_per_day: maximum number of samples per vehicle-day, evenly spaced.
        time_limit: stop after this duration, as in 9m, with a checkpoint to continue from.
        threads: CPU threads.
    """
    import torch

    from jobs.terminal.summary import progress_reporter
    from jobs.train import parse_duration, report_training
    from pipeline.core.config import load_fleet
    from pipeline.learn.perception_training.radar_drivable.network import export_drivable
    from pipeline.learn.perception_training.radar_drivable.samples import drivable_samples
    from pipeline.learn.perception_training.radar_drivable.training import DrivableTraining, train_drivable
    from pipeline.store.partitions import Lake

    limit = None if time_limit is None else parse_duration(time_limit, "time-limit")
    config = DrivableTraining(steps=steps, batch_size=batch_size, learning_rate=learning_rate, seed=seed)
    with progress_reporter("samples"):
        train, held_out, data = drivable_samples(load_fleet(fleet), Lake.at(lake), frames_per_day)
    torch.set_num_threads(threads)
    with progress_reporter(f"train {out.name}") as progress:
        network, result = train_drivable(train, held_out, out, config, limit, progress)
    outputs: list[Path] = []
    if result.status == "done":
        card = {"data": data, "training": config.model_dump(), "iou_held_out": result.report}
        outputs = [export_drivable(network, out, card)]
    return report_training("train-radar-drivable", result, out, "iou", outputs=outputs, **data)
