"""Lakes that hold given frames and observations, as ingest and perceive would have written them."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from pipeline.rig.prior import to_rows
from pipeline.store.commits import commit_records
from pipeline.store.moments import write_moments
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import FRAMES_OF_PAIR
from schemas.captures import CAPTURES
from schemas.columns import TableSchema
from schemas.features import FEATURES
from schemas.frames import Frame
from schemas.moments import MOMENTS, PERCEIVED, PRIOR, Moment, Perceived
from schemas.observations import Observation


def write_records(lake: Lake, schema: TableSchema, rows: Sequence[Any], work_key: str) -> None:
    """Commit records under one work key."""
    commit_records(lake, schema, [replace(row, work_key=work_key) for row in rows])


def write_frames(
    lake: Lake, partition: Partition, frames: Sequence[Frame], key: str = "frames-key", **extra: Any
) -> None:
    """Put the frames of a rig with a camera, a lidar and a radar into a lake."""
    _write(lake, partition, MOMENTS, frames, key, extra)


def write_observations(
    lake: Lake, partition: Partition, observations: Sequence[Observation], key: str = "observations-key",
    **extra: Any,
) -> None:  # fmt: skip
    """Put the observations of such a rig into a lake."""
    _write(lake, partition, PERCEIVED, observations, key, extra)


def joined_of(seen: Frame | Observation) -> tuple[Moment | Perceived, dict[str, Any]]:
    """The rows that a view joins: the moment's, and one of each sensor."""
    tables = CAPTURES if isinstance(seen, Frame) else FEATURES
    return _moment(seen), {kind: _part(seen, kind, tables[kind]) for kind in seen.sensors}


def _write(lake, partition, schema, seen, key, extra):
    with write_moments(lake, schema, partition, key) as writer:
        for one in seen:
            writer.append(*joined_of(one))
        counts = {"kept": {"frames": len(seen)}, "rejected": {}}
        writer.describe(**counts, **{PRIOR: prior_rows(seen)} | extra)


def prior_rows(seen):
    """What a manifest says of the priors that frames or observations carry, by log."""
    rows = []
    for one in seen:
        star = {FRAMES_OF_PAIR[pair]: T for pair, T in one.priors.items()}
        rows += [{"log": one.log, **row} for row in to_rows([star])]
    return [row for i, row in enumerate(rows) if row not in rows[:i]]


def _moment(one):
    kind = Moment if isinstance(one, Frame) else Perceived
    own = {"moment": one.frame_index, "rows": {}, "gap_ns": {}}
    return kind(**{f.name: own[f.name] if f.name in own else getattr(one, f.name) for f in fields(kind)})


def _part(one, kind, table):
    stamp_ns = one.stamp_ns if kind == "lidar" else getattr(one, f"{kind}_stamp_ns")
    own = {"moment": one.frame_index, "stamp_ns": stamp_ns}
    row = table.row_type
    names = [
        f.name for f in fields(row) if f.name in own or hasattr(one, f.name)
    ]  # a frame has no earlier image
    return row(**{name: own[name] if name in own else getattr(one, name) for name in names})
