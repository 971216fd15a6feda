"""Frames of a vehicle-day as Parquet files of many frames each: `SPLIT/VEHICLE_DAY-NNNNNN.parquet`."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.learn.frames.frame import LIDAR_FIELDS, RADAR_FIELDS, Frame, facts_of, points_of
from pipeline.learn.frames.output import DayOutput
from schemas.captures import Image, Sweep

__all__ = ["FRAMES_PER_SHARD", "ShardWriter"]

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
