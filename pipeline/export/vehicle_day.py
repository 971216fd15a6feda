"""Frames of a vehicle-day with their features, for formats that show a drive."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import Chosen, frames_of, ingested, observations_of, perceived
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["read_scenes"]


def read_scenes(
    lake: Lake, partition: Partition, most: int, chosen: Chosen | None = None
) -> Iterator[tuple[Frame, Observation | None]]:
    """At most `most` frames, evenly spread, in order of stamp; features are None if perception left it out.

    Raises:
        ConfigError: the lake has no frames of that day.
        DamagedError, CollectedError: a file of the day is damaged or was deleted after its retention.
    """
    manifest = ingested(lake, partition)
    if manifest is None:
        problem = f"the lake has no frames of {partition.vehicle} {partition.day}: ingest the day's logs"
        raise ConfigError("command line", "day", problem)
    picked = np.unique(np.linspace(0, max(manifest.rows - 1, 0), most).round().astype(int)).tolist()
    # Empty for a day that was not perceived.
    seen = iter(()) if perceived(lake, partition) is None else observations_of(lake, partition, None, chosen)
    observation = next(seen, None)
    for frame in frames_of(lake, partition, picked, chosen):
        while observation is not None and observation.frame_index < frame.frame_index:
            observation = next(seen, None)
        is_its = observation is not None and observation.frame_index == frame.frame_index
        yield frame, observation if is_its else None
