"""`boresight train-lidar-semantics`: train lidar semantics; the camera is the teacher."""

from __future__ import annotations

from pathlib import Path

from jobs.extras import needs

__all__ = ["train_lidar_semantics"]


@needs("train")
def train_lidar_semantics(  # options of the command
    *,
    fleet: Path,
    lake: str,
    out: Path,
    steps: int = 400,
    batch_size: int = 4,
    learning_rate: float = 4e-3,
    seed: int = 0,
    frames_per_day: int = 30,
    rows: int = 48,
    columns: int = 1024,
    time_limit: str | None = None,
    threads: int = 1,
) -> int:
    """Train on frames and observations, or continue the run in OUT; writes lidar_semantics.onnx and .toml.

    Set the .toml in fleet.toml: `semantics = { source = "onnx", segmenter = "lidar_semantics.toml" }` under
    the rig's lidar. Labels are the camera's, projected through the day's accepted calibration, or its prior
    if there is none. Every fifth vehicle-day is held out; at least two vehicle-days are needed.

    Args:
        fleet: fleet.toml; sets the source of each vehicle's prior.
        lake: folder of the tables, with frames, observations and, if available, calibrations.
        out: folder of the run: last.pt, metrics.jsonl, the model with its manifest and card.
        steps: total number of steps.
        batch_size: sweeps per step.
        learning_rate: initial learning rate; decays to 1e-5.
        seed: random seed.
        frames_per_day: maximum number of sweeps per vehicle-day, evenly spaced.
        rows: rows of the range image, over the lidar's field of view.
        columns: columns of the range image, over 360 deg.
        time_limit: stop after this duration, as in 9m, with a checkpoint to continue from.
        threads: CPU threads.
    """
    import torch

    from jobs.terminal.summary import progress_reporter
    from jobs.train import parse_duration, report_training
    from pipeline.core.config import load_fleet
    from pipeline.learn.perception_training.lidar_semantics.network import export_sweeps
    from pipeline.learn.perception_training.lidar_semantics.samples import labelled_sweeps, normal_of
    from pipeline.learn.perception_training.lidar_semantics.training import SweepTraining, train_sweeps
    from pipeline.store.partitions import Lake

    limit = None if time_limit is None else parse_duration(time_limit, "time-limit")
    config = SweepTraining(steps=steps, batch_size=batch_size, learning_rate=learning_rate, seed=seed)
    with progress_reporter("samples"):
        samples = labelled_sweeps(load_fleet(fleet), Lake.at(lake), (rows, columns), frames_per_day)
    torch.set_num_threads(threads)
    with progress_reporter(f"train {out.name}") as progress:
        network, result = train_sweeps(samples.train, samples.held_out, out, config, limit, progress)
    outputs: list[Path] = []
    if result.status == "done":
        scores = {"held_out_against_projected_labels": result.report}
        card = {"data": samples.numbers, "training": config.model_dump(), **scores}
        outputs = [export_sweeps(network, samples.layout, normal_of(samples.train), out, card)]
    return report_training("train-lidar-semantics", result, out, "scores", outputs=outputs, **samples.numbers)
