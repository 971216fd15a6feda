"""One rig per vehicle: accepted days of every sensor's pose since it last moved, fused per sensor.

A day's poses are one adjustment of all its edges, so all edges take part. A sensor's pose restarts if the
sensor itself or the reference moved. It does not restart if another sensor moved, even one whose edges
determine it.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.audit.days import DOFS, last_level
from pipeline.audit.estimates import (
    COLUMNS,
    Estimates,
    day_name,
    days_of,
    estimates_at,
    estimates_of,
    faults_of,
)
from pipeline.audit.service import restart_of, what_was_done
from pipeline.audit.state_rows import fused_as_they_differ, with_state
from pipeline.config import VerifyConfig
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.se3 import adjoint, inverse
from pipeline.rig.edges import edge_order
from pipeline.rig.graph import Edge, Sensor, is_one_of_each, tie
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns
from schemas.drift import DriftFinding
from schemas.poses import POSES
from schemas.service_events import ServiceEvent
from schemas.states import StateRow

__all__ = ["Poses", "pose_states", "read_poses", "since_of_pose"]

_OF_POSES = {c.name for c in POSES.columns}
_NO_VALUE = pa.float64()  # of what records of edges say besides


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a fleet over a window of days.

    Args:
        estimates: by tie of sensor and reference; their T is T_reference_sensor, whichever is the tie's
            parent.
        last_words: day, status and reason of the last row, by vehicle and sensor.
        other_days: days left out because their poses refer to another sensor, by vehicle.
    """

    estimates: Estimates
    references: Mapping[str, Sensor]
    last_words: Mapping[tuple[str, str], tuple[str, str, str]]
    other_days: Mapping[str, Sequence[str]]


def read_poses(lake: Lake, method: str, first: str, last: str) -> Poses:
    """Current poses in a window of days; rows of the reference sensor name the reference of the other poses."""
    asked = [c for c in COLUMNS if c in _OF_POSES]
    table = read_columns(lake, POSES, [*asked, "kind", "reference", "reason"], first=first, last=last)
    if table is None:
        return Poses(estimates_of(None), {}, {}, {})
    found = current_rows(
        table.filter(pc.equal(table["method"], method)), POSES
    )  # in order of vehicle and day
    names = ("vehicle", "day", "sensor", "kind", "reference", "status", "reason")
    rows = list(zip(*(found[name].to_pylist() for name in names), strict=True))
    kinds = {(vehicle, sensor): kind for vehicle, _, sensor, kind, *_ in rows}
    referred = {vehicle: reference for vehicle, _, _, _, reference, *_ in rows}
    # Records of a rig with one sensor of each kind are of the adjusted poses: their states are its own.
    of_vehicle = {v: [Sensor(s, kind) for (w, s), kind in kinds.items() if w == v] for v in referred}
    references = {
        v: Sensor(r, kinds[v, r])
        for v, r in referred.items()
        if (v, r) in kinds and not is_one_of_each(of_vehicle[v])
    }
    ties = [
        tie(Sensor(sensor, kind), references[vehicle])
        if vehicle in references and sensor != reference == references[vehicle].name
        else None
        for vehicle, _, sensor, kind, reference, *_ in rows
    ]
    edges = tuple(sorted({edge for edge in ties if edge is not None}, key=edge_order))
    kept = np.flatnonzero([edge is not None for edge in ties])
    other: dict[str, dict[str, None]] = {}
    for vehicle, day, _, _, reference, *_ in rows:
        if reference != referred[vehicle]:
            other.setdefault(vehicle, {})[day] = None
    for name in COLUMNS:
        if name not in _OF_POSES:
            kind = pa.binary() if name == "half_days" else _NO_VALUE
            found = found.append_column(name, pa.nulls(found.num_rows, kind))
    place = {edge: k for k, edge in enumerate(edges)}
    at = np.array([place[edge] for edge in ties if edge is not None], np.int64)
    estimates = estimates_at(found.take(pa.array(kept)), edges, at)
    sound = np.setdiff1d(np.arange(len(estimates.day)), list(faults_of(estimates, last)))
    words = {(vehicle, sensor): (day, status, why) for vehicle, day, sensor, _, _, status, why in rows}
    return Poses(estimates.at(sound), references, words, {v: list(days) for v, days in other.items()})


def pose_states(
    about: tuple[str, str, str],
    poses: Poses,
    known: tuple[Sequence[ServiceEvent], Sequence[DriftFinding]],
    scales: Mapping[Edge, Float[np.ndarray, " 6"]],
    verify: VerifyConfig,
) -> list[StateRow]:
    """One row per sensor of a vehicle, the reference's first; no rows if no rig of the vehicle was adjusted.

    `scales` are ratios of the scatter of its days to their sigmas, by tie and DoF.
    """
    vehicle, last, method = about
    if vehicle not in poses.references:
        return []
    reference, records = poses.references[vehicle], poses.estimates.of(vehicle)
    empty = StateRow(
        vehicle=vehicle, day=last, method=method, pair="pose", parent_frame=reference.name, child_frame="",
        status="none", reason="",
    )  # fmt: skip
    known_of = [(edge, scales.get(edge, np.ones(DOFS))) for edge in records.own_edges()]
    rows = [_row(empty, edge, scale, records, poses, known, verify) for edge, scale in known_of]
    days = sorted({day for row in rows for day in row.days})
    own: dict[str, Any] = {"child_frame": reference.name, "sensor": reference.name, "kind": reference.kind}
    if not days:
        return [replace(empty, **own, reason="no pose refers to it yet"), *rows]
    exact = {"covariance": np.zeros((6, 6)), "common_covariance": np.zeros((6, 6))}
    own |= {
        **pose_columns(np.eye(4)),
        **exact,
        "status": "current",
        "reason": "poses refer to it",
        "days": days,
    }
    return [replace(empty, **own), *rows]


def _row(
    empty: StateRow,
    edge: Edge,
    scale: Float[np.ndarray, " 6"],
    records: Estimates,
    poses: Poses,
    known: tuple[Sequence[ServiceEvent], Sequence[DriftFinding]],
    verify: VerifyConfig,
) -> StateRow:
    """The state of one sensor's pose."""
    reference = poses.references[empty.vehicle]
    sensor = edge.other(reference.name)
    first, why = since_of_pose(sensor, edge, *known, empty.day)
    begin = dt.date.fromisoformat(first).toordinal() if first else 0
    usable = records.is_of(edge) & records.accepted & records.has_estimate & (records.day >= begin)
    own, moved = _since_it_lies_here(records.at(np.flatnonzero(usable)), scale)
    first, why = moved or (first, why)
    found, wider = fused_as_they_differ(own, scale)
    why = "; ".join(text for text in (why, wider) if text)
    row = replace(
        empty, child_frame=sensor.name, sensor=sensor.name, kind=sensor.kind, since=first or None,
        reason=_words(why, poses, (empty.vehicle, sensor.name), found is None),
    )  # fmt: skip
    if found is None:
        return row
    T = inverse(found.T)
    A = adjoint(T)
    seen = f"{sensor.kind}_{reference.kind}", T, A @ found.covariance @ A.T
    return with_state(row, found, own, seen, verify)


def _since_it_lies_here(
    own: Estimates, scale: Float[np.ndarray, " 6"]
) -> tuple[Estimates, tuple[str, str] | None]:
    """Days since the last change of the pose that is visible in the days, and the reason in words.

    A chart needs two weeks of days. Until then, a mean over days before and after a knock would match neither pose.
    """
    for days in days_of(own, 1.0).values():  # of one tie
        rest = last_level(days, scale)
        if len(rest.day) < len(days.day):
            day = day_name(int(rest.day[0]))
            return own.at(slice(len(days.day) - len(rest.day), None)), (
                day,
                f"its days show another pose since {day}; a chart needs more days",
            )
    return own, None


def _words(why: str, poses: Poses, of: tuple[str, str], is_none: bool) -> str:
    """Reason for the days of a pose; without days, the reason of its last day."""
    others = poses.other_days.get(of[0], ())
    apart = f"not counted, because their poses refer to another sensor: {', '.join(others)}" if others else ""
    day, status, reason = poses.last_words[of]
    none = f"no accepted day {why}".rstrip() if is_none else why
    said = f"{day} {status}: {reason}" if is_none and status != "accepted" else ""
    return "; ".join(text for text in (none, said, apart) if text)


def since_of_pose(
    sensor: Sensor, edge: Edge, events: Sequence[ServiceEvent], findings: Sequence[DriftFinding], last: str
) -> tuple[str, str]:
    """First day from which a sensor's pose to the reference may be averaged, and why; empty if all days may be."""
    first, why = "", ""
    event = restart_of(events, edge, last)
    if event is not None:
        first, why = (
            day_name(dt.date.fromisoformat(event.day).toordinal() + 1),
            f"after the {what_was_done(event)}",
        )
    reference = edge.other(sensor.name).name
    for finding in findings:
        if finding.status not in ("RED", "YELLOW") or not finding.start_day:
            continue
        named = finding.moved_sensor
        # Of an edge that changed without a sensor to blame, either end may have moved; that the reference did would
        # show on its other edges too.
        moved = {finding.parent_frame, finding.child_frame} - {reference} if named is None else {named}
        if {sensor.name, reference} & moved and (finding.start_day_latest or "") > first:
            first = finding.start_day_latest or ""
            why = f"after a change of {named or f'{finding.parent_frame}-{finding.child_frame}'} that the audit found "
            why += f"since {finding.start_day}"
    return first, why
