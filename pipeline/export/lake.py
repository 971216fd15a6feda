"""Read a calibration from the lake: a day's records, or a vehicle's state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import numpy as np

from pipeline.errors import ConfigError, ContractError
from pipeline.export.calibration import USABLE, ExportedPair, is_frame
from pipeline.geometry.cameras import Camera, camera_of
from pipeline.geometry.se3 import adjoint, inverse
from pipeline.rig.edges import edge_of, edge_order, words_of
from pipeline.rig.graph import Edge, Kind, Sensor, is_one_of_each, tie
from pipeline.store.current import current_poses, current_records, current_states, prior_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import ingested, observations_of, perceived
from schemas.calibrations import CALIBRATIONS, DOF_NAMES, CalibrationRecord
from schemas.poses import POSES, PoseRow
from schemas.states import STATES, StateRow

__all__ = [
    "choose_pairs",
    "edges_of_vehicle",
    "pairs_of_day",
    "pairs_of_poses",
    "pairs_of_state",
    "priors_of_day",
    "read_cameras",
    "read_frame_ids",
    "rest_at_prior",
]

# Fields of a record or state for the provenance, if present.
_DETAILS = (
    *("day", "days", "since", "work_key", "recorded_at", "inputs", "notes", "assumptions"),
    *("edges", "dt_s", "time_offset_s", "time_offset_sigma_s", "azimuth_sigma_rad", "elevation_sigma_rad"),
    *("mounting_determined", "mounting_azimuth_sigma_rad", "mounting_elevation_sigma_rad"),
)


def pairs_of_day(lake: Lake, vehicle: str, day: str, method: str) -> dict[str, ExportedPair | str]:
    """Estimates of the day's current records by edge name, or the reason why there is none.

    Raises:
        ConfigError: no record of that vehicle, day and method; the message lists the existing ones.
    """
    return _pairs(_records(lake, vehicle, day, method))


def pairs_of_poses(lake: Lake, vehicle: str, day: str | None, method: str) -> dict[Edge, ExportedPair | str]:
    """Poses relative to the reference, from the day's adjusted rig or (no day) the vehicle's state.

    Keys are edges to the reference. Empty for a vehicle whose rig is not adjusted as a whole, and for a
    vehicle with one sensor of each kind, whose records hold the adjusted poses already.

    Raises:
        ConfigError: as `pairs_of_day`, or no state of that vehicle and method is stored.
    """
    own: list[tuple[str, str, str, PoseRow | StateRow]]
    if day is None:
        states = current_states(read_records(lake, STATES, StateRow, vehicle=vehicle))
        own = [(s.sensor, s.kind or "", s.parent_frame, s) for s in states if s.sensor and s.method == method]
    else:
        poses = current_poses(read_records(lake, POSES, PoseRow, vehicle=vehicle, day=day))
        own = [(p.sensor, p.kind, p.reference, p) for p in poses if p.method == method]
    nodes = {s.name: s for edge in edges_of_vehicle(lake, vehicle, day, method) for s in edge.sensors}
    if is_one_of_each(nodes.values()):
        return {}
    nodes |= {name: Sensor(name, cast("Kind", kind)) for name, kind, *_ in own}
    ties = {tie(nodes[n], nodes[r]): (n, row) for n, _, r, row in own if n != r and r in nodes}
    return {edge: _pair_of_pose(ties[edge][1], ties[edge][0], edge) for edge in sorted(ties, key=edge_order)}


def _pair_of_pose(row: PoseRow | StateRow, sensor: str, edge: Edge) -> ExportedPair | str:
    """Pose of a sensor as its edge to the reference, whichever of the two is the parent."""
    T, covariance, common = transform_of(row), row.covariance, row.common_covariance
    if T is None or covariance is None:
        return f"{row.status}: {row.reason}"
    seen, reason = tuple(row.observable or [True] * 6), row.reason
    if edge.parent.name == sensor:
        T = inverse(T)
        A = adjoint(T)
        covariance, common = A @ covariance @ A.T, None if common is None else A @ common @ A.T
        unseen = ", ".join(dof for dof, is_seen in zip(DOF_NAMES, seen, strict=True) if not is_seen)
        # The degrees of freedom refer to axes of the reference; in axes of the sensor they are mixed.
        own = f"{unseen} along the axes of {edge.child.name} kept at the prior" if unseen else ""
        seen, reason = (True,) * 6, "; ".join(words for words in (reason, own) if words)
    return ExportedPair(
        words_of(edge),
        T,
        covariance,
        row.status,
        reason,
        seen,
        tuple(row.determined),
        common,
        _details(row),
        of=edge,
    )


def priors_of_day(lake: Lake, vehicle: str, day: str, method: str) -> dict[str, ExportedPair | str]:
    """Priors of the day's records by edge name, or the reason for none; errors as `pairs_of_day`."""
    found: dict[str, ExportedPair | str] = {}
    for record in _records(lake, vehicle, day, method):
        T, edge = prior_of(record), edge_of(record)
        words = words_of(edge)
        found[words] = (
            "no prior was given"
            if T is None
            else ExportedPair(words, T, record.prior_covariance, "prior", certified=(), of=edge)
        )
    return found


def edges_of_vehicle(lake: Lake, vehicle: str, day: str | None, method: str) -> tuple[Edge, ...]:
    """All edges in the day's records or (no day) in the states."""
    if day is None:
        rows: Sequence[CalibrationRecord | StateRow] = _states(lake, vehicle, method)
    else:
        rows = _records(lake, vehicle, day, method)
    return tuple(edge_of(row) for row in rows)


def _records(lake: Lake, vehicle: str, day: str, method: str) -> list[CalibrationRecord]:
    Partition(vehicle, day)  # raises for an invalid vehicle or day
    records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day))
    found = [r for r in records if r.method == method]
    if not found:
        methods = sorted({r.method for r in records})
        there = f"; there are records of {', '.join(methods)}" if methods else ""
        raise ConfigError(
            "command line", "day", f"the lake has no record of {vehicle} {day} by {method}{there}"
        )
    return found


def pairs_of_state(lake: Lake, vehicle: str, method: str) -> dict[str, ExportedPair | str]:
    """Edges that a vehicle should load tonight, by name, or the reason for none; else ConfigError."""
    return _pairs(_states(lake, vehicle, method))


def _states(lake: Lake, vehicle: str, method: str) -> list[StateRow]:
    rows = current_states(read_records(lake, STATES, StateRow, vehicle=vehicle))
    found = [r for r in rows if r.method == method and r.sensor is None]
    if not found:
        problem = f"the lake has no state of {vehicle} by {method}: run `boresight audit`, or give --day"
        raise ConfigError("command line", "vehicle", problem)
    return found


def _pairs(rows: Sequence[CalibrationRecord] | Sequence[StateRow]) -> dict[str, ExportedPair | str]:
    by_edge = {edge_of(row): _pair(row) for row in rows}
    return {words_of(edge): by_edge[edge] for edge in sorted(by_edge, key=edge_order)}


def _pair(row: CalibrationRecord | StateRow) -> ExportedPair | str:
    T = transform_of(row)
    if T is None:
        return f"{row.status}: {row.reason}"
    edge = edge_of(row)
    return ExportedPair(
        words_of(edge),
        T,
        row.covariance,
        row.status,
        row.reason,
        tuple(row.observable or [True] * 6),
        tuple(row.determined),
        row.common_covariance,
        _details(row),
        _unchecked(row),
        of=edge,
    )


def _details(row: CalibrationRecord | StateRow | PoseRow) -> dict[str, object]:
    return {name: value for name in _DETAILS if (value := getattr(row, name, None)) not in (None, "", [])}


def _unchecked(row: CalibrationRecord | StateRow) -> dict[str, float]:
    if isinstance(row, StateRow):
        return row.unchecked
    found = {dof: row.diagnostics.get(f"unchecked_{dof}_sigmas") for dof in DOF_NAMES}
    return {dof: sigmas for dof, sigmas in found.items() if sigmas is not None}


def rest_at_prior(
    lake: Lake, vehicle: str, method: str, pairs: Mapping[str, ExportedPair]
) -> dict[str, ExportedPair]:
    """Pairs with unchecked DoF that are far from the prior reset to the prior of their last day's record."""
    return {name: _rested(lake, vehicle, method, pair) for name, pair in pairs.items()}


def _rested(lake: Lake, vehicle: str, method: str, pair: ExportedPair) -> ExportedPair:
    days = pair.details.get("days") or [pair.details.get("day")]
    if not pair.unchecked or not isinstance(days, list):
        return pair
    for record in _records(lake, vehicle, str(days[-1]), method):
        T = prior_of(record)
        if edge_of(record) == pair.edge and T is not None and record.prior_covariance is not None:
            return pair.resting_at(T, record.prior_covariance)
    return pair


def choose_pairs(
    found: Mapping[str, ExportedPair | str], *, force: bool
) -> tuple[dict[str, ExportedPair], dict[str, str]]:
    """Pairs that may be loaded (with `force` all that have a transform), and reasons for those left out."""
    chosen: dict[str, ExportedPair] = {}
    left_out: dict[str, str] = {}
    for name, pair in found.items():
        if isinstance(pair, str):
            left_out[name] = pair
        elif pair.status in USABLE or force:
            chosen[name] = pair
        else:
            left_out[name] = f"{pair.status}: {pair.reason}"
    return chosen, left_out


def read_cameras(lake: Lake, vehicle: str, days: Iterable[str], cameras: Sequence[str]) -> dict[str, Camera]:
    """Intrinsics by camera, each from the latest of these days that has observations of it in the lake."""
    found: dict[str, Camera] = {}
    for day in sorted(days, reverse=True):
        partition = Partition(vehicle, day)
        try:
            if perceived(lake, partition) is None:
                continue
            for name in (name for name in cameras if name not in found):
                own = observations_of(lake, partition, chosen={"camera": name})
                seen = next((o for o in own if "camera" in o.sensors), None)
                if seen is not None:
                    camera = camera_of(seen)
                    K, D = np.array(camera.K), np.array(camera.D)
                    found[name] = Camera(camera.model, K, D, camera.width_px, camera.height_px)
        except ContractError as err:  # damaged, or deleted at the end of its retention
            lake.damage.append(str(err))
    return found


def read_frame_ids(lake: Lake, vehicle: str, days: Iterable[str]) -> dict[str, str]:
    """Frame of each sensor in the logs of the latest of these days, unless it has several."""
    for day in sorted(days, reverse=True):
        try:
            manifest = ingested(lake, Partition(vehicle, day))
        except ContractError as err:  # damaged
            lake.damage.append(str(err))
            continue
        known = {} if manifest is None else manifest.extra.get("frame_ids", {})
        names = {sensor: ids[0].lstrip("/") for sensor, ids in known.items() if len(ids) == 1}
        if names:
            return (
                names if len(set(names.values())) == len(names) and all(map(is_frame, names.values())) else {}
            )
    return {}
