"""One vehicle-day of an export: its frames in a format, then a marker that it is complete."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

from pipeline.core.results import Progress
from pipeline.learn.frames.frame import Frame, Mounting, Perturbation, Place, read_frames
from pipeline.learn.frames.nuscenes import NuScenesWriter
from pipeline.learn.frames.output import DayOutput, Output
from pipeline.learn.frames.shards import ShardWriter
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.tables import read_manifest
from schemas.moments import MOMENTS, PERCEIVED
from schemas.versions import CODE_VERSION

__all__ = ["FORMATS", "DayTask", "FrameWriter", "export_day"]

_TOO_FEW = "fewer_than_two_sensors"


class FrameWriter(Protocol):
    """Writes the frames of one vehicle-day."""

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        ...

    def close(self) -> None:
        """Write the rest."""
        ...


FORMATS: dict[str, Callable[[DayOutput, ExitStack], FrameWriter]] = {
    "parquet": ShardWriter,
    "nuscenes": NuScenesWriter,
}


@dataclass(frozen=True)
class DayTask:
    """Input of a worker for one vehicle-day."""

    lake: Lake
    partition: Partition
    output: Output
    format: str
    places: Sequence[Place]
    lost: dict[str, int]
    mounting: Mounting
    perturbation: Perturbation | None


def export_day(task: DayTask, progress: Progress) -> str:
    """Write a vehicle-day unless it exists from the same data, calibration and plan: 'done' or 'cached'."""
    output, key = task.output, _key(task)
    before = output.done(task.partition)
    if before is not None and before["work_key"] == key:
        return "cached"
    with output.writing(task.partition) as own:
        told = _write(task, own, progress)
    mounting = task.mounting
    poses = {
        n: {"T_reference_sensor": T.tolist()} | dict(mounting.about.get(n, {})) for n, T in mounting.T.items()
    }
    calibration: dict[str, Any] = {
        "source": mounting.source,
        "reference": mounting.reference,
        "sensors": poses,
    }
    calibration["left_out"] = dict(mounting.left_out)
    about = {"work_key": key, "vehicle": task.partition.vehicle, "day": task.partition.day}
    output.finish(task.partition, about | told | {"calibration": calibration})
    return "done"


def _write(task: DayTask, output: DayOutput, progress: Progress) -> dict[str, dict[str, int]]:
    """Write the frames; counts by split, of those left out by reason, and of sensors' data."""
    kept, lost, sensors = Counter[str](), Counter(task.lost), Counter[str]()
    with ExitStack() as stack:
        writer = FORMATS[task.format](output, stack)
        frames = read_frames(task.lake, task.partition, task.places, task.mounting, task.perturbation)
        for done, frame in enumerate(frames):
            progress(done, len(task.places), "frames")
            if frame is None:
                lost[_TOO_FEW] += 1
                continue
            writer.add(frame)
            kept[frame.at.split] += 1
            sensors.update(list(frame.captures))
        writer.close()
    return {"frames": dict(kept), "left_out": dict(lost), "sensors": dict(sensors)}


def _key(task: DayTask) -> str:
    inputs = [m.work_key for t in (MOMENTS, PERCEIVED) if (m := read_manifest(task.lake, t, task.partition))]
    return work_key(
        "frames",
        CODE_VERSION,
        repr((task.format, task.places, task.mounting.digest, task.perturbation)),
        inputs,
    )
