"""Frames and observations of one camera, one lidar and one radar, joined from a lake's tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, Final

import numpy as np

from pipeline.rig.prior import Star, between, transform_of_row
from pipeline.store.moments import joined, sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import Manifest, read_manifest
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS
from schemas.captures import ImageColumns, ScanColumns, SweepColumns
from schemas.columns import Column, TableSchema
from schemas.features import ImageFeatureColumns, ScanFeatureColumns, SweepFeatureColumns
from schemas.frames import Frame
from schemas.moments import MOMENTS, PERCEIVED, PRIOR, EgoColumns, Moment
from schemas.observations import Observation

__all__ = [
    "Chosen", "frame_of", "frames_of", "ingested", "logged_stars", "observations_of", "perceived",
    "perceived_days", "priors_of",
]  # fmt: skip

Chosen = Mapping[str, str]  # names of the camera, lidar and radar of a view, by kind; some may be missing

# For a missing sensor: value of a column by column name, else by kind.
_EMPTY: Final[Mapping[str, Any]] = {
    "camera_K": np.full((3, 3), np.nan), "label_scale": 1.0,
    "binary": b"", "string": "", "int32": 0, "float64": 0.0, "bool": False, "list<string>": [],
}  # fmt: skip
_MEASURED = {"camera": ImageColumns, "lidar": SweepColumns, "radar": ScanColumns}
_FOUND = {"camera": ImageFeatureColumns, "lidar": SweepFeatureColumns, "radar": ScanFeatureColumns}


def ingested(lake: Lake, partition: Partition) -> Manifest | None:
    """Ingest manifest of a vehicle-day, or None; ContractError if damaged or of another release."""
    return read_manifest(lake, MOMENTS, partition)


def perceived(lake: Lake, partition: Partition) -> Manifest | None:
    """Perceive manifest of a vehicle-day, or None; ContractError if damaged or of another release."""
    return read_manifest(lake, PERCEIVED, partition)


def perceived_days(lake: Lake) -> list[Partition]:
    """Vehicle-days that were perceived, in order."""
    return lake.partitions(PERCEIVED.name)


def frames_of(
    lake: Lake, partition: Partition, moments: Sequence[int] | None = None, chosen: Chosen | None = None
) -> Iterator[Frame]:
    """Frames of a vehicle-day in order of time; one row group of each sensor is in memory.

    `moments` selects moments (None = all), `chosen` sensors (None = the first camera, lidar and radar).
    Moments with fewer than two of several chosen sensors are left out.

    Raises:
        ContractError: the lake has none of that day, or they are of another release.
        DamagedError: a file cannot be read.
        CollectedError: the rows were deleted at the end of their retention.
    """
    for moment, rows, priors in _seen(lake, MOMENTS, partition, moments, chosen):
        yield frame_of(moment, rows, priors)


def observations_of(
    lake: Lake, partition: Partition, moments: Sequence[int] | None = None, chosen: Chosen | None = None,
    known: dict[str, list[Any]] | None = None,
) -> Iterator[Observation]:  # fmt: skip
    """Observations of a vehicle-day; arguments and errors as `frames_of`, `known` as `joined`."""
    for moment, rows, priors in _seen(lake, PERCEIVED, partition, moments, chosen, known):
        yield Observation(
            **_stamps(moment, rows), priors=priors, ego_speed_mps=moment.ego_speed_mps,
            ego_yaw_rate_radps=moment.ego_yaw_rate_radps, **_columns(rows, _FOUND),
        )  # fmt: skip


def frame_of(moment: Moment, rows: Mapping[str, Any], priors: Mapping[str, np.ndarray]) -> Frame:
    """A moment as a frame of one camera, lidar and radar: captures by kind, and the priors of their pairs."""
    return Frame(
        **_stamps(moment, rows), priors=priors, lidar_stamp_ns=_stamp(moment, rows, "lidar"),
        **_values(moment, EgoColumns), **_columns(rows, _MEASURED),
    )  # fmt: skip


def priors_of(star: Star, chosen: Chosen) -> dict[str, np.ndarray]:
    """Transforms of the pairs of chosen sensors; camera-radar only if not given by the other two."""
    found = {}
    for pair in PAIRS:
        a, b = (chosen.get(kind) for kind in FRAMES_OF_PAIR[pair])
        T = None if a is None or b is None else between(star, a, b)
        if T is not None:
            found[pair] = T
    if len(found) == len(PAIRS):
        del found["camera_radar"]
    return found


def logged_stars(rows: Iterable[Mapping[str, Any]]) -> Mapping[str, Star]:
    """Transforms in each log (`rows` of a manifest's PRIOR), by log name; the first ones of several."""
    found: dict[str, dict[tuple[str, str], np.ndarray]] = {}
    for row in rows:
        found.setdefault(row["log"], {}).setdefault((row["parent"], row["child"]), transform_of_row(row))
    return found


def _seen(
    lake: Lake,
    schema: TableSchema,
    partition: Partition,
    moments: Sequence[int] | None,
    chosen: Chosen | None,
    known: dict[str, list[Any]] | None = None,
) -> Iterator[tuple[Any, dict[str, Any], dict[str, np.ndarray]]]:
    """Moments with the rows of the chosen sensors, by kind, and their priors."""
    manifest = read_manifest(lake, schema, partition)
    sensors = {} if manifest is None else sensors_of(manifest)
    logged = () if manifest is None else manifest.extra.get(PRIOR, ())
    names = {kind: name for name, kind in reversed(sensors.items())} if chosen is None else dict(chosen)
    priors = {log: priors_of(star, names) for log, star in logged_stars(logged).items()}
    for moment, found in joined(lake, schema, partition, list(names.values()), moments, known):
        rows = {kind: found[name] for kind, name in names.items() if name in found}
        if len(rows) >= min(2, len(names)):
            yield moment, rows, priors.get(moment.log, {})


def _stamps(moment: Any, rows: Mapping[str, Any]) -> dict[str, Any]:
    stamps = {f"{kind}_stamp_ns": _stamp(moment, rows, kind) for kind in ("camera", "radar")}
    return stamps | {
        "frame_index": moment.moment,
        "log": moment.log,
        "drive": moment.drive,
        "stamp_ns": _stamp(moment, rows, "lidar"),
        "sensors": [kind for kind in ("camera", "lidar", "radar") if kind in rows],
    }


def _stamp(moment: Any, rows: Mapping[str, Any], kind: str) -> int:
    stamp_ns: int = rows[kind].stamp_ns if kind in rows else moment.stamp_ns
    return stamp_ns


def _columns(rows: Mapping[str, Any], of_kind: Mapping[str, type]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for kind, columns in of_kind.items():
        values |= _values(rows.get(kind) or _nothing(columns), columns)
    return values


def _values(row: Any, columns: type) -> dict[str, Any]:
    return {f.name: getattr(row, f.name) for f in fields(columns)}


@cache
def _nothing(columns: type) -> Any:
    """Values of a view for a missing sensor: null, empty bytes, arrays without rows, 0, no camera matrix."""
    return columns(**{c.name: _empty(c) for c in TableSchema(columns, "", 0).columns})


def _empty(column: Column) -> Any:
    if column.nullable:
        return None
    if column.is_array and column.name not in _EMPTY:
        return np.zeros([0 if size == "N" else size for size in column.shape], column.dtype)
    return _EMPTY.get(column.name, _EMPTY.get(column.kind))
