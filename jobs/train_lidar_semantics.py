"""`boresight train-lidar-semantics`: a small range-image network for lidar points, taught by the camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from jobs.extras import needs

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from pipeline.config import FleetConfig
    from pipeline.learn.perception.lidar_semantics.samples import SweepImages, SweepLayout
    from pipeline.store.partitions import Lake, Partition
    from schemas.frames import Frame
    from schemas.observations import Observation

__all__ = ["train_lidar_semantics"]


@needs("train")
def train_lidar_semantics(
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
    """Train on frames and observations, or go on with the run in OUT; leaves lidar_semantics.onnx and .toml there.

    Name the .toml in fleet.toml: `semantics = { source = "onnx", segmenter = "lidar_semantics.toml" }` under the rig's
    lidar. Labels are the camera's, through the day's accepted calibration where the lake has one, else its prior.
    Every fifth vehicle-day is held out; two are needed at least.

    Args:
        fleet: fleet.toml; says where each vehicle's prior comes from.
        lake: folder of the tables, with frames and observations, and perhaps calibrations.
        out: folder of the run: last.pt, metrics.jsonl, the model with its manifest and card.
        steps: steps in all.
        batch_size: sweeps per step.
        learning_rate: at the start; falls to 1e-5.
        seed: of everything random.
        frames_per_day: sweeps of a vehicle-day at most, evenly spread.
        rows: of the range image, over the lidar's field of view.
        columns: of the range image, all the way round.
        time_limit: stop this call after so long, as in 9m, with a checkpoint to go on from.
        threads: of the processor.
    """
    from dataclasses import asdict

    import torch

    from jobs.terminal.summary import print_summary, progress_reporter
    from jobs.train import parse_duration
    from pipeline.config import load_fleet
    from pipeline.learn.perception.lidar_semantics.export import export_sweeps
    from pipeline.learn.perception.lidar_semantics.training import SweepTraining, normal_of, train_sweeps
    from pipeline.store.partitions import Lake

    limit = None if time_limit is None else parse_duration(time_limit, "time-limit")
    config = SweepTraining(steps, batch_size, learning_rate, seed=seed)
    days = _days(load_fleet(fleet), Lake.at(lake))
    layout = _layout(days, Lake.at(lake), rows, columns)
    train, held_out, data = _samples(days, Lake.at(lake), layout, frames_per_day)
    torch.set_num_threads(threads)
    with progress_reporter(f"train {out.name}") as progress:
        network, result = train_sweeps(train, held_out, out, config, limit, progress)
    outputs: list[Path] = []
    if result.status == "done":
        card = {"data": data, "training": asdict(config), "held_out_against_projected_labels": result.scores}
        outputs = [export_sweeps(network, layout, normal_of(train), out, card)]
    fields = asdict(result)
    print_summary("train-lidar-semantics", fields.pop("status"), out=out, outputs=outputs, **data, **fields)
    return 128 + result.signal if result.signal else 0


def _days(config: FleetConfig, lake: Lake) -> list[tuple[Partition, list[Observation], np.ndarray, bool]]:
    """Days with their observations, T_camera_lidar, and whether it was accepted."""
    from pipeline.errors import ContractError
    from pipeline.extrinsics.prior import read_prior
    from pipeline.store.current import current_records, transform_of
    from pipeline.store.tables import read_records, read_rows
    from schemas.calibrations import CALIBRATIONS, CalibrationRecord
    from schemas.observations import OBSERVATIONS, Observation

    partitions = [p for p in lake.partitions(OBSERVATIONS.name) if p.vehicle in config.vehicles]
    if len(partitions) < 2:
        told = f"{len(partitions)} vehicle-days with observations of vehicles in fleet.toml: two are needed"
        raise ContractError(str(lake.root), told)
    accepted = {
        (r.vehicle, r.day): transform_of(r)
        for r in current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
        if r.pair == "camera_lidar" and r.status == "accepted"
    }
    days = []
    for partition in partitions:
        rows = read_rows(lake, OBSERVATIONS, partition, Observation)
        known = accepted.get((partition.vehicle, partition.day))
        if known is None:
            prior = read_prior(rows, config, partition.vehicle)
            days.append((partition, rows, prior.T_camera_lidar, False))
        else:
            days.append((partition, rows, known, True))
    return days


def _layout(
    days: list[tuple[Partition, list[Observation], np.ndarray, bool]], lake: Lake, rows: int, columns: int
) -> SweepLayout:
    """From the first sweep of each day."""
    from pipeline.learn.perception.lidar_semantics.samples import layout_of

    return layout_of((next(_frames(lake, day[0])) for day in days), rows, columns)


def _samples(
    days: list[tuple[Partition, list[Observation], np.ndarray, bool]],
    lake: Lake,
    layout: SweepLayout,
    per_day: int,
) -> tuple[SweepImages, SweepImages, dict[str, int]]:
    """Sweeps to learn from, held-out sweeps, and their numbers."""
    from pipeline.learn.perception.lidar_semantics.samples import cut, day_images

    parts = [
        day_images(_frames(lake, partition), rows, T_camera_lidar, layout, per_day)
        for partition, rows, T_camera_lidar, _ in days
    ]
    train, held_out = cut(
        [i for k, part in enumerate(parts) if k % 5 != 1 for i in part],
        [i for k, part in enumerate(parts) if k % 5 == 1 for i in part],
    )
    numbers = {"vehicle_days": len(days), "calibrated_days": sum(day[3] for day in days)}
    return train, held_out, numbers | {"samples": len(train), "held_out_samples": len(held_out)}


def _frames(lake: Lake, partition: Partition) -> Iterator[Frame]:
    from pipeline.store.tables import iterate_rows
    from schemas.frames import FRAMES, Frame

    for group in iterate_rows(lake, FRAMES, partition, Frame):
        yield from group
