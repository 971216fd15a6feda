"""Vehicle-days of an export: the split of their frames, then one at a time, with a marker that it is complete.

In Parquet, files have many frames each: `SPLIT/VEHICLE_DAY-NNNNNN.parquet`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core.config import PrepareConfig
from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress
from pipeline.learn.frames.frame import (
    LIDAR_FIELDS,
    RADAR_FIELDS,
    Frame,
    Mounting,
    Perturbation,
    Place,
    facts_of,
    points_of,
    read_frames,
    to_json,
)
from pipeline.learn.frames.nuscenes import NuScenesWriter
from pipeline.learn.frames.output import DayOutput, Output
from pipeline.learn.prepare.sides import decided_sides, frame_sides, settled_keys, split_settings
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.tables import read_manifest
from schemas.captures import Image, Sweep
from schemas.moments import MOMENTS, PERCEIVED
from schemas.training import SPLITS
from schemas.versions import CODE_VERSION

__all__ = ["FRAMES_PER_SHARD", "DayTask", "ShardWriter", "export_day", "plan_frames"]

FRAMES_PER_SHARD = 128  # of a real car 100 to 250 MB: what loaders of shards advise
_SENSOR = pa.struct([
    pa.field("name", pa.string()), pa.field("image", pa.binary()), pa.field("labels_png", pa.binary()),
    pa.field("points", pa.binary()), pa.field("fields", pa.list_(pa.string())),
])  # fmt: skip
_SCHEMA = pa.schema([
    ("key", pa.string()), ("vehicle", pa.string()), ("day", pa.string()), ("stamp_ns", pa.int64()),
    ("split", pa.string()), ("about", pa.string()), ("sensors", pa.list_(_SENSOR)),
])  # fmt: skip


class ShardWriter:
    """Writes a row group per frame, so that a loader reads any frame alone; one schema for every rig.

    One file of each split is open at a time.
    """

    def __init__(self, output: DayOutput, stack: ExitStack) -> None:
        self._output, self._stack = output, stack
        self._open: dict[str, tuple[pq.ParquetWriter, ExitStack]] = {}
        self._count: dict[str, int] = {}

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        split = frame.at.split
        count = self._count.get(split, 0)
        if count % FRAMES_PER_SHARD == 0:
            self._close(split)
            name = f"{split}/{frame.key.rpartition('_')[0]}-{count // FRAMES_PER_SHARD:06d}.parquet"
            own = self._stack.enter_context(ExitStack())
            stream = own.enter_context(self._output.replacing(name))
            writer = pq.ParquetWriter(stream, _SCHEMA, compression="ZSTD", use_dictionary=False)
            own.callback(writer.close)
            self._open[split] = writer, own
            self._output.list("files", name)
            self._output.list(split, name)
        facts = facts_of(frame)
        row = {name: facts.get(name) for name in _SCHEMA.names}
        row |= {"about": json.dumps(facts, sort_keys=True, allow_nan=False)}
        row |= {"sensors": [_sensor(frame, name) for name in frame.captures]}
        self._open[split][0].write_table(pa.Table.from_pylist([row], _SCHEMA))
        self._count[split] = count + 1

    def close(self) -> None:
        """Give the last files their names."""
        for split in list(self._open):
            self._close(split)

    def _close(self, split: str) -> None:
        if split in self._open:
            self._open.pop(split)[1].close()


def _sensor(frame: Frame, name: str) -> dict[str, Any]:
    capture = frame.captures[name]
    if isinstance(capture, Image):
        labels = frame.seen[name].labels_png if name in frame.seen else None
        return {"name": name, "image": capture.image, "labels_png": labels}
    fields = LIDAR_FIELDS if isinstance(capture, Sweep) else RADAR_FIELDS
    return {"name": name, "points": points_of(capture).tobytes(), "fields": list(fields)}


_FILE = "plan.json"
_KEYS = {"split_by": "[prepare.split] by", "seed": "[prepare] seed"}  # in fleet.toml, of `split_settings`
_Planned = dict[Partition, tuple[list[Place], Counter[str]]]  # wanted frames, and those left out by reason


def plan_frames(
    lake: Lake, days: Sequence[Partition], config: PrepareConfig, output: Output, settings: Mapping[str, Any],
    progress: Progress,
) -> tuple[_Planned, dict[str, Any]]:  # fmt: skip
    """Divide the frames of all days by `[prepare]`; splits of earlier runs and of table `training` stay.

    Returns the frames, and the settings of the export with those of its splits.

    Raises:
        ConfigError: the export was begun with other settings, or a requested split is empty.
    """
    before = output.read(_FILE)
    if before is not None:
        config = _as_begun(config, settings, before["settings"])
    surveys = []
    for done, day in enumerate(days):
        progress(done, len(days), f"{day.vehicle} {day.day}")
        surveys.append(survey_day(day, lake, config))
    if before is not None:
        decided = {(kind, value): side for kind, value, side in before["sides"]}
    else:
        config = config.split_with(by=settled_keys(surveys, config, lake))
        decided = decided_sides(lake, config)
    plan = plan_days(surveys, config, decided)
    planned: _Planned = {}
    for survey in surveys:
        sides, lost = frame_sides(survey, plan, config)
        wanted = [k for k, side in enumerate(sides) if side is not None]
        places = [Place(k, sides[k] or "", survey.place[k], survey.environment[k]) for k in wanted]
        planned[survey.partition] = places, lost
    _require_splits(config, planned)
    all_sides = sorted([kind, value, side] for (kind, value), side in (decided | dict(plan.sides)).items())
    whole = _with_split(settings, config)
    output.write(_FILE, to_json({"settings": whole, "sides": all_sides}))
    return planned, whole


def _as_begun(config: PrepareConfig, settings: Mapping[str, Any], begun: Mapping[str, Any]) -> PrepareConfig:
    """The configuration with the keys of the export that was begun; ConfigError if anything else differs."""
    if "by" not in config.split.model_fields_set:
        config = config.split_with(by=tuple(begun["split"]["split_by"]))
    now = _with_split(settings, config)
    changed = [n for n in settings if begun.get(n) != now[n]]
    other = [n for n, value in now["split"].items() if begun["split"][n] != value]
    changed += [_KEYS.get(n, f"[prepare.split] {n}") for n in other]
    if changed:
        raise ConfigError("command line", "out", f"holds an export with another {', '.join(changed)}")
    return config


def _with_split(settings: Mapping[str, Any], config: PrepareConfig) -> dict[str, Any]:
    """The settings, and those that name places, because different places with the same name would leak."""
    whole: dict[str, Any] = json.loads(to_json({**settings, "split": split_settings(config)}))
    return whole


def _require_splits(config: PrepareConfig, planned: _Planned) -> None:
    """Raise ConfigError if a requested split has no frame."""
    counts = Counter(place.split for places, _ in planned.values() for place in places)
    shares = dict(zip(SPLITS, (1.0, config.split.val_fraction, config.split.test_fraction), strict=True))
    empty = [side for side, share in shares.items() if share > 0 and not counts[side]]
    if empty:
        problem = (
            f"no frames for {', '.join(empty)}: too few vehicles, days and places to keep splits apart by "
            f'{", ".join(config.split.by)}; set by = "place", or export with --unsplit: all into train'
        )
        raise ConfigError("fleet.toml", "prepare.split.by", problem)


_FORMATS: dict[str, type[ShardWriter | NuScenesWriter]] = {"parquet": ShardWriter, "nuscenes": NuScenesWriter}


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
    output, settings = task.output, (task.format, task.places, task.mounting.digest, task.perturbation)
    inputs = [m.work_key for t in (MOMENTS, PERCEIVED) if (m := read_manifest(task.lake, t, task.partition))]
    key = work_key("frames", CODE_VERSION, repr(settings), inputs)
    before = output.done(task.partition)
    if before is not None and before["work_key"] == key:
        return "cached"
    with output.writing(task.partition) as own:
        told = _write(task, own, progress)
    mounting = task.mounting
    poses = {
        n: {"T_reference_sensor": T.tolist()} | dict(mounting.about.get(n, {})) for n, T in mounting.T.items()
    }
    calibration = {
        "source": mounting.source, "reference": mounting.reference, "sensors": poses,
        "left_out": dict(mounting.left_out),
    }  # fmt: skip
    about = {"work_key": key, "vehicle": task.partition.vehicle, "day": task.partition.day}
    output.finish(task.partition, about | told | {"calibration": calibration})
    return "done"


def _write(task: DayTask, output: DayOutput, progress: Progress) -> dict[str, dict[str, int]]:
    """Write the frames; counts by split, of those left out by reason, and of sensors' data."""
    kept, lost, sensors = Counter[str](), Counter(task.lost), Counter[str]()
    with ExitStack() as stack:
        writer = _FORMATS[task.format](output, stack)
        frames = read_frames(task.lake, task.partition, task.places, task.mounting, task.perturbation)
        for done, frame in enumerate(frames):
            progress(done, len(task.places), "frames")
            if frame is None:
                lost["fewer_than_two_sensors"] += 1
                continue
            writer.add(frame)
            kept[frame.at.split] += 1
            sensors.update(list(frame.captures))
        writer.close()
    return {"frames": dict(kept), "left_out": dict(lost), "sensors": dict(sensors)}
