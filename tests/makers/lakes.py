"""Lakes that hold given frames and observations, as ingest and perceive would have written them."""

from collections.abc import Sequence
from typing import Any

from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import write_partition
from schemas.frames import FRAMES, Frame
from schemas.observations import OBSERVATIONS, Observation


def write_frames(
    lake: Lake,
    partition: Partition,
    frames: Sequence[Frame],
    key: str = "frames-key",
    group: int = 4,
    **extra: Any,
) -> None:
    """Put frames into a lake, so many in a row group."""
    _write(lake, FRAMES, partition, frames, key, group, extra)


def write_observations(
    lake: Lake,
    partition: Partition,
    observations: Sequence[Observation],
    key: str = "observations-key",
    group: int = 4,
    **extra: Any,
) -> None:
    """Put observations into a lake, so many in a row group."""
    _write(lake, OBSERVATIONS, partition, observations, key, group, extra)


def _write(lake, schema, partition, rows, key, group, extra):
    with write_partition(lake, schema, partition, key, "test") as writer:
        for first in range(0, len(rows), group):
            writer.append(rows[first : first + group])
        writer.describe(kept={"frames": len(rows)}, rejected={}, **extra)
