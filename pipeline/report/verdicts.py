"""The last audit's findings of a whole fleet, as columns; whole rows only of vehicles with a change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from pipeline.rig.graph import Edge, edges_of_rows
from pipeline.rig.kinds import EDGE_KINDS
from pipeline.store.corrections import read_corrections
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake
from pipeline.store.records import read_last_columns
from pipeline.store.rows import from_table, known_rows, ordinals, places
from schemas.calibrations import DOF_NAMES
from schemas.drift import DRIFT, DRIFT_STATUSES, DriftFinding

__all__ = ["ChartVerdicts", "FleetVerdicts", "read_verdicts"]

# `inputs` is most of a row, and no page shows it.
_COLUMNS = tuple(c.name for c in DRIFT.columns if c.name not in {"inputs", "recorded_at"})
_ALARMS = ("RED", "YELLOW")


@dataclass(frozen=True, eq=False)
class ChartVerdicts:
    """Charts in order of vehicle; start days are ordinals of the calendar, 0 where nothing changed.

    Args:
        owner: place in `FleetVerdicts.vehicles`.
        edges: that any chart is of, in order.
        edge: which of them a chart is of.
        dof: place in DOF_NAMES.
        status: place in DRIFT_STATUSES.
        limit: size of a change that matters [rad or m].
        start: first day with the new value, its earliest and its latest.
    """

    edges: tuple[Edge, ...]
    owner: Int[np.ndarray, " N"]
    edge: Int[np.ndarray, " N"]
    dof: Int[np.ndarray, " N"]
    status: Int[np.ndarray, " N"]
    limit: Float[np.ndarray, " N"]
    start: Int[np.ndarray, "N 3"]


@dataclass(frozen=True, eq=False)
class FleetVerdicts:
    """Findings of every vehicle's last audit.

    Args:
        findings: by vehicle: all of its findings where something changed, else one, which has the vehicle's
            status.
        audited: days that the audits ended with.
        corrections: by vehicle, what its configuration or recording needs before more days help.
    """

    vehicles: list[str]
    findings: Mapping[str, Sequence[DriftFinding]]
    charts: ChartVerdicts
    audited: list[str] = field(default_factory=list)
    work_keys: list[str] = field(default_factory=list)
    corrections: Mapping[str, str] = field(default_factory=dict)


def read_verdicts(lake: Lake, method: str) -> FleetVerdicts:
    """The findings of the last audit of the method; audits look at all vehicles."""
    found = read_last_columns(lake, DRIFT, method, _COLUMNS)
    if found is None:
        none = np.zeros(0, np.int64)
        empty = ChartVerdicts((), none, none, none, none, np.zeros(0), np.zeros((0, 3), np.int64))
        return FleetVerdicts([], {}, empty, corrections=read_corrections(lake))
    found = known_rows(
        current_rows(found, DRIFT), {"pair": EDGE_KINDS, "dof": DOF_NAMES, "status": DRIFT_STATUSES}
    )
    names = found["vehicle"].combine_chunks().dictionary_encode()
    vehicles, owner = names.dictionary.to_pylist(), np.asarray(names.indices).astype(np.int64)
    return FleetVerdicts(
        vehicles,
        _findings(found, owner),
        _charts(found, owner),
        sorted(found["day"].unique().to_pylist()),
        sorted(found["work_key"].unique().to_pylist()),
        read_corrections(lake),
    )


def _findings(found: pa.Table, owner: Int[np.ndarray, " N"]) -> dict[str, list[DriftFinding]]:
    alarmed = np.asarray(pc.is_in(found["vehicle_status"], pa.array(_ALARMS)).combine_chunks())
    wanted = np.asarray(alarmed, bool) | np.append(True, owner[1:] != owner[:-1])
    by_vehicle: dict[str, list[DriftFinding]] = {}
    for finding in from_table(found.filter(pa.array(wanted)), DRIFT, DriftFinding):
        by_vehicle.setdefault(finding.vehicle, []).append(finding)
    return by_vehicle


def _charts(found: pa.Table, owner: Int[np.ndarray, " N"]) -> ChartVerdicts:
    names = ("start_day", "start_day_earliest", "start_day_latest")
    starts = np.stack([ordinals(found[name]) for name in names], axis=1)
    edges, edge = edges_of_rows(found)
    return ChartVerdicts(
        edges,
        owner,
        edge,
        places(found["dof"], DOF_NAMES),
        places(found["status"], DRIFT_STATUSES),
        found["limit"].to_numpy(),
        np.where((starts > 0).all(axis=1, keepdims=True), starts, 0),
    )
