"""Frames of a vehicle-day as shards, files of many frames each: `SPLIT/VEHICLE_DAY-NNNNNN.tar` or `.parquet`."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, BinaryIO, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.learn.frames.facts import facts_of, to_json
from pipeline.learn.frames.frame import LIDAR_FIELDS, RADAR_FIELDS, Frame, points_of
from pipeline.learn.frames.output import FRAMES_PER_SHARD, DayOutput
from schemas.captures import Image, Sweep

__all__ = ["ShardWriter"]


class _Shard(Protocol):
    def add(self, frame: Frame) -> None: ...
    def close(self) -> None: ...


class ShardWriter:
    """Writes frames of a vehicle-day; one shard of each split is open at a time."""

    def __init__(self, output: DayOutput, stack: ExitStack, suffix: str) -> None:
        self._output, self._stack, self._suffix = output, stack, suffix
        self._open: dict[str, tuple[_Shard, ExitStack]] = {}
        self._count: dict[str, int] = {}

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        split = frame.at.split
        count = self._count.get(split, 0)
        if count % FRAMES_PER_SHARD == 0:
            self._close(split)
            name = f"{split}/{frame.key.rpartition('_')[0]}-{count // FRAMES_PER_SHARD:06d}.{self._suffix}"
            own = self._stack.enter_context(ExitStack())
            stream = own.enter_context(self._output.replacing(name))
            shard: _Shard = TarShard(stream) if self._suffix == "tar" else ParquetShard(stream)
            own.callback(shard.close)
            self._open[split] = shard, own
            self._output.list("files", name)
            self._output.list(split, name)
        self._open[split][0].add(frame)
        self._count[split] = count + 1

    def close(self) -> None:
        """Give the last shards their names."""
        for split in list(self._open):
            self._close(split)

    def _close(self, split: str) -> None:
        if split in self._open:
            self._open.pop(split)[1].close()


class TarShard:
    """A WebDataset shard. Files of one KEY are a sample: KEY.SENSOR.jpg, KEY.SENSOR.npy, KEY.json and more.

    Source: webdataset, docs, "WebDataset Format": what precedes the first dot of a name is the key.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._tar = tarfile.open(fileobj=stream, mode="w", format=tarfile.GNU_FORMAT)  # noqa: SIM115 - `close`

    def add(self, frame: Frame) -> None:
        """Write the files of a frame, one after the other, as loaders need them."""
        for name, data in _files(frame):
            member = tarfile.TarInfo(f"{frame.key}.{name}")
            member.size, member.mtime = len(data), frame.moment.stamp_ns // 10**9
            self._tar.addfile(member, io.BytesIO(data))

    def close(self) -> None:
        """Write the end of the archive."""
        self._tar.close()


def _files(frame: Frame) -> Iterator[tuple[str, bytes]]:
    for sensor, capture in frame.captures.items():
        if isinstance(capture, Image):
            yield f"{sensor}.{'jpg' if capture.image_format == 'jpeg' else 'png'}", capture.image
            if sensor in frame.seen:
                yield f"{sensor}.labels.png", frame.seen[sensor].labels_png
        else:
            held = io.BytesIO()
            np.save(held, points_of(capture))
            yield f"{sensor}.npy", held.getvalue()
    yield "json", to_json(facts_of(frame))


_SENSOR = pa.struct([
    pa.field("name", pa.string()), pa.field("image", pa.binary()), pa.field("labels_png", pa.binary()),
    pa.field("points", pa.binary()), pa.field("fields", pa.list_(pa.string())),
])  # fmt: skip
_SCHEMA = pa.schema([
    ("key", pa.string()), ("vehicle", pa.string()), ("day", pa.string()), ("stamp_ns", pa.int64()),
    ("split", pa.string()), ("about", pa.string()), ("sensors", pa.list_(_SENSOR)),
])  # fmt: skip


class ParquetShard:
    """A Parquet file with a row group per frame, so that a loader reads any frame alone; one schema for every rig."""

    def __init__(self, stream: BinaryIO) -> None:
        self._parquet = pq.ParquetWriter(stream, _SCHEMA, compression="ZSTD", use_dictionary=False)

    def add(self, frame: Frame) -> None:
        """Write a frame as a row group."""
        facts = facts_of(frame)
        row = {name: facts.get(name) for name in _SCHEMA.names}
        row |= {"about": json.dumps(facts, sort_keys=True, allow_nan=False)}
        row["sensors"] = [_sensor(frame, name) for name in frame.captures]
        self._parquet.write_table(pa.Table.from_pylist([row], _SCHEMA))

    def close(self) -> None:
        """Write the footer."""
        self._parquet.close()


def _sensor(frame: Frame, name: str) -> dict[str, Any]:
    capture = frame.captures[name]
    if isinstance(capture, Image):
        labels = frame.seen[name].labels_png if name in frame.seen else None
        return {"name": name, "image": capture.image, "labels_png": labels}
    fields = LIDAR_FIELDS if isinstance(capture, Sweep) else RADAR_FIELDS
    return {"name": name, "points": points_of(capture).tobytes(), "fields": list(fields)}
