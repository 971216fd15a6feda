"""Current record of each vehicle, day, method and edge, and the transforms in records."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.rig.graph import pose_of
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.columns import TableSchema
from schemas.drift import DriftFinding
from schemas.poses import POSES, PoseRow
from schemas.service_events import ServiceEvent
from schemas.states import STATES, StateRow
from schemas.words import AXIS_NAMES, axes_in_words

__all__ = [
    "current_drift", "current_events", "current_poses", "current_records", "current_rows", "current_states",
    "prior_of", "state_values", "targets_of", "transform_of",
]  # fmt: skip

_Row = TypeVar("_Row")
_Said = TypeVar("_Said", DriftFinding, StateRow)


def current_records(records: Sequence[CalibrationRecord]) -> list[CalibrationRecord]:
    """The current record of each (vehicle, day, method, edge), in this order; `records` by assertion."""
    return _last_of_each(records, CALIBRATIONS)


def current_poses(poses: Sequence[PoseRow]) -> list[PoseRow]:
    """The current pose of each (vehicle, day, method, sensor), in this order; `poses` by assertion."""
    return _last_of_each(poses, POSES)


def _last_of_each(rows: Sequence[_Row], schema: TableSchema) -> list[_Row]:
    last = {schema.about_of(row): row for row in rows}
    return [last[about] for about in sorted(last)]


def current_rows(table: pa.Table, schema: TableSchema) -> pa.Table:
    """Current row of each key (`schema.about`) of a record table, as columns, in order of key.

    `table` has the key, `asserted_at` and `work_key`, in any order of rows.
    """
    if not table.num_rows:
        return table
    columns = [
        table[name].combine_chunks().dictionary_encode()
        for name in (*schema.about, "asserted_at", "work_key")
    ]
    ranks = [_ranks(column) for column in columns]
    order = np.lexsort(ranks[::-1])
    about = np.stack([rank[order] for rank in ranks[:-2]])
    is_last = np.append((about[:, 1:] != about[:, :-1]).any(axis=0), True)
    return table.take(pa.array(order[is_last]))


def _ranks(column: pa.DictionaryArray) -> np.ndarray:
    """For each row, the rank of its value among the sorted values."""
    places = np.empty(len(column.dictionary), np.int64)
    places[np.asarray(pc.sort_indices(column.dictionary))] = np.arange(len(places))
    return places[np.asarray(column.indices)]


def current_drift(findings: Sequence[DriftFinding]) -> list[DriftFinding]:
    """Findings of the last audit that included a vehicle, by vehicle and method, in order."""
    return sorted(_asserted_last(findings), key=lambda f: (f.vehicle, f.method, *_edge(f), f.dof))


def current_states(states: Sequence[StateRow]) -> list[StateRow]:
    """States of a vehicle from the last night that included it, by vehicle and method, in order."""
    return sorted(_asserted_last(states), key=lambda s: (s.vehicle, s.method, *_edge(s)))


def _edge(row: DriftFinding | StateRow) -> tuple[str, str, str]:
    return row.pair, row.parent_frame, row.child_frame


def _asserted_last(rows: Sequence[_Said]) -> list[_Said]:
    """Rows of each vehicle and method under the latest stamp."""
    last: dict[tuple[str, str], str] = {}
    for row in rows:
        key = (row.vehicle, row.method)
        last[key] = max(last.get(key, ""), row.asserted_at)
    return [row for row in rows if row.asserted_at == last[row.vehicle, row.method]]


def current_events(events: Sequence[ServiceEvent]) -> list[ServiceEvent]:
    """Latest version of each event, without withdrawn events; `events` by assertion."""
    noted = {(e.vehicle, e.day, e.sensor, e.kind): e for e in events}
    return [event for event in noted.values() if not event.withdrawn]


def transform_of(record: CalibrationRecord | StateRow | PoseRow) -> Float[np.ndarray, "4 4"] | None:
    """T_parent_child of a record or state, T_reference_sensor of a pose; None without an estimate."""
    return pose_of(partial(getattr, record))


def prior_of(record: CalibrationRecord | PoseRow) -> Float[np.ndarray, "4 4"] | None:
    """Prior T_parent_child of a record, or of a pose; None if none was given."""
    return pose_of(partial(getattr, record), "prior_")


def targets_of(record: CalibrationRecord) -> Float[np.ndarray, "N 3"]:
    """Targets of a record's sigmas, in the child's frame [m]; the default ones if it has none."""
    return DEFAULT_TARGETS if record.targets_m is None else np.asarray(record.targets_m)


def state_values(states: Sequence[StateRow]) -> list[dict[str, Any]]:
    """Each state as a dict of its columns, with "T", "T_prior" (4x4 or None) and "in_words"."""
    kinds = {(s.vehicle, s.method, s.sensor): s.kind for s in states if s.sensor is not None}
    return [
        {c.name: getattr(s, c.name) for c in STATES.columns}
        | {
            "T": pose_of(partial(getattr, s)),
            "T_prior": pose_of(partial(getattr, s), "prior_"),
            "in_words": _in_words(s, kinds.get((s.vehicle, s.method, s.parent_frame))),
        }
        for s in states
    ]


def _in_words(state: StateRow, parent_kind: str | None) -> str:
    if state.observable is None or state.sensor == state.parent_frame:
        return ""
    kind = parent_kind if parent_kind in AXIS_NAMES else state.pair.partition("_")[0]
    return axes_in_words(kind if kind in AXIS_NAMES else "lidar", state.observable, state.determined)
