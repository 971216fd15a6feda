"""What one camera, one lidar and one radar saw at a moment, joined of a lake's tables: frames and observations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import Manifest, iterate_rows, read_manifest
from schemas.frames import FRAMES, Frame
from schemas.observations import OBSERVATIONS, Observation

__all__ = ["frames_of", "ingested", "observations_of", "perceived", "perceived_days"]


def ingested(lake: Lake, partition: Partition) -> Manifest | None:
    """What ingest says of a vehicle-day; None where the lake has nothing of it.

    Raises:
        ContractError: it is damaged, or of another release.
    """
    return read_manifest(lake, FRAMES, partition)


def perceived(lake: Lake, partition: Partition) -> Manifest | None:
    """What perceive says of a vehicle-day; None where the lake has nothing of it.

    Raises:
        ContractError: it is damaged, or of another release.
    """
    return read_manifest(lake, OBSERVATIONS, partition)


def perceived_days(lake: Lake) -> list[Partition]:
    """Vehicle-days that were perceived, in order."""
    return lake.partitions(OBSERVATIONS.name)


def frames_of(lake: Lake, partition: Partition, moments: Sequence[int] | None = None) -> Iterator[Frame]:
    """Frames of a vehicle-day in order of time, a row group in memory at a time; of some moments where these are named.

    Raises:
        ContractError: the lake has none of that day, or they are of another release.
        DamagedError: a file cannot be read.
        CollectedError: they left the lake after their time.
    """
    return chain.from_iterable(iterate_rows(lake, FRAMES, partition, Frame, moments))


def observations_of(
    lake: Lake, partition: Partition, moments: Sequence[int] | None = None
) -> Iterator[Observation]:
    """Observations of a vehicle-day, likewise.

    Raises:
        ContractError: the lake has none of that day, or they are of another release.
        DamagedError: a file cannot be read.
        CollectedError: they left the lake after their time.
    """
    wanted = None if moments is None else set(moments)
    rows = chain.from_iterable(iterate_rows(lake, OBSERVATIONS, partition, Observation))
    return (o for o in rows if wanted is None or o.frame_index in wanted)
