"""Read a calibration from the lake: a day's records, or a vehicle's state; and frames of a day."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np

from pipeline.core.errors import ConfigError, ContractError
from pipeline.export.calibration import USABLE, ExportedPair, is_frame
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.graph import Edge, Kind, Sensor, edge_of, edge_order, is_one_of_each, tie, words_of
from pipeline.rig.prior import transform_of_row
from pipeline.rig.se3 import adjoint, inverse
from pipeline.rig.transform_tree import TransformTree
from pipeline.store.corrections import read_sign_offs
from pipeline.store.current import current_poses, current_records, current_states, prior_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import Chosen, frames_of, ingested, observations_of, perceived
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.frames import Frame
from schemas.moments import TF
from schemas.observations import Observation
from schemas.poses import POSES, PoseRow
from schemas.states import STATES, StateRow
from schemas.words import AXIS_NAMES

__all__ = [
    "choose_pairs",
    "pairs_of",
    "priors_of_day",
    "read_cameras",
    "read_frame_ids",
    "read_scenes",
    "read_tf",
    "signed_state",
]

# Fields of a record or state for the provenance, if present.
_DETAILS = (
    *("day", "days", "since", "work_key", "recorded_at", "inputs", "notes", "assumptions"),
    *("edges", "dt_s", "time_offset_s", "time_offset_sigma_s", "azimuth_sigma_rad", "elevation_sigma_rad"),
    *("mounting_determined", "mounting_azimuth_sigma_rad", "mounting_elevation_sigma_rad"),
)


def pairs_of(
    lake: Lake, vehicle: str, day: str | None, method: str, *, is_signed: bool = False
) -> dict[Edge, ExportedPair | str]:
    """Edges of every sensor to the reference, of a day or (no day) of the vehicle's state; else the reason for none.

    `is_signed`: the state that was signed off last. With camera-radar of a rig of three, beside the edges to the lidar.
    Numbers are those of the stored rows, to the last digit: rows of edges where they hold the sensors' poses, else rows
    of the sensors.

    Raises:
        ConfigError: no state of that vehicle and method, or no record of that day; the message lists those there are.
    """
    rows: Sequence[CalibrationRecord | StateRow]
    poses: list[tuple[str, str, str, PoseRow | StateRow]]
    if day is None:
        states = signed_state(lake, vehicle, method) if is_signed else _states(lake, vehicle, method)
        rows = [r for r in states if r.sensor is None]
        poses = [(r.sensor, r.kind or "", r.parent_frame, r) for r in states if r.sensor is not None]
    else:
        rows = _records(lake, vehicle, day, method)
        found = current_poses(read_records(lake, POSES, PoseRow, vehicle=vehicle, day=day))
        poses = [(p.sensor, p.kind, p.reference, p) for p in found if p.method == method]
    of_edge = {edge_of(row): row for row in rows}
    nodes = {s.name: s for edge in of_edge for s in edge.sensors}
    nodes |= {name: Sensor(name, cast("Kind", kind)) for name, kind, *_ in poses}
    ties = {tie(nodes[n], nodes[r]): (n, row) for n, _, r, row in poses if n != r and r in nodes}
    of_three = is_one_of_each(nodes.values())
    chosen: dict[Edge, ExportedPair | str] = {
        edge: _pair(edge, row, name)
        if edge not in of_edge or _is_left_out(of_edge[edge])
        else _pair(edge, of_edge[edge])
        for edge, (name, row) in ties.items()
    }
    if of_three or not ties:
        chosen |= {edge: _pair(edge, row) for edge, row in of_edge.items() if edge not in chosen}
    return {edge: chosen[edge] for edge in sorted(chosen, key=edge_order)}


def _is_left_out(row: CalibrationRecord | StateRow) -> bool:
    """Whether a record states what its edge found alone, and not the pose of the adjusted rig."""
    return isinstance(row, CalibrationRecord) and row.used is False and row.own_covariance is None


def _pair(
    edge: Edge, row: CalibrationRecord | StateRow | PoseRow, sensor: str | None = None
) -> ExportedPair | str:
    """An edge by its own row, or by the pose of its `sensor` in the other one; the reason if it has no transform."""
    T, covariance, common = transform_of(row), row.covariance, row.common_covariance
    if T is None or (sensor is not None and covariance is None):
        return f"{row.status}: {row.reason}"
    seen, reason = tuple(row.observable or [True] * 6), row.reason
    if edge.parent.name == sensor:
        T = inverse(T)
        A = adjoint(T)
        covariance, common = (None if C is None else A @ C @ A.T for C in (covariance, common))
        names = zip(AXIS_NAMES[edge.child.kind], seen, strict=True)
        unseen = ", ".join(name for name, is_seen in names if not is_seen)
        if row.status != "prior":
            # The degrees of freedom refer to axes of the reference; in axes of the sensor they are mixed.
            own = f"{unseen} along the axes of {edge.child.name} kept at the prior" if unseen else ""
            seen, reason = (True,) * 6, "; ".join(words for words in (reason, own) if words)
    given = {name: getattr(row, name, None) for name in _DETAILS}
    details = {name: value for name, value in given.items() if value not in (None, "", [])}
    return ExportedPair(edge, T, covariance, row.status, reason, seen, tuple(row.determined), common, details)


def priors_of_day(lake: Lake, vehicle: str, day: str, method: str) -> dict[str, ExportedPair | str]:
    """Priors of the day's records by edge name, or the reason for none; errors as `pairs_of`."""
    found: dict[str, ExportedPair | str] = {}
    records = {edge_of(record): record for record in _records(lake, vehicle, day, method)}
    for edge in sorted(records, key=edge_order):
        T, C = prior_of(records[edge]), records[edge].prior_covariance
        found[words_of(edge)] = (
            "no prior was given" if T is None else ExportedPair(edge, T, C, "prior", certified=())
        )
    return found


def _records(lake: Lake, vehicle: str, day: str, method: str) -> list[CalibrationRecord]:
    Partition(vehicle, day)  # raises for an invalid vehicle or day
    records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day))
    found = [r for r in records if r.method == method]
    if not found:
        methods = sorted({r.method for r in records})
        others = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle)
        last = sorted({r.day for r in others if r.method == method})[-3:]
        there = f"; there are records of {', '.join(methods or last)}" if methods or last else ""
        raise ConfigError(
            "command line", "day", f"the lake has no record of {vehicle} {day} by {method}{there}"
        )
    return found


def _states(lake: Lake, vehicle: str, method: str) -> list[StateRow]:
    rows = current_states(read_records(lake, STATES, StateRow, vehicle=vehicle))
    found = [r for r in rows if r.method == method]
    if not found:
        problem = f"the lake has no state of {vehicle} by {method}: run `boresight audit`, or give --day"
        raise ConfigError("command line", "vehicle", problem)
    return found


def signed_state(lake: Lake, vehicle: str, method: str, *, before: bool = False) -> list[StateRow]:
    """The state that was signed off last; `before`: the one that was signed off before it. ConfigError if none was."""
    found = read_sign_offs(lake, method, vehicle)[::-1]
    chosen = next((s for s in found if not before or s.state_key != found[0].state_key), None)
    if chosen is None:
        which = "only one state" if found else "no state"
        problem = f"{which} of {vehicle} is signed off: sign one off with `boresight state --sign-off NAME`"
        raise ConfigError("command line", "previous" if before else "signed-off", problem)
    rows = read_records(lake, STATES, StateRow, vehicle=vehicle)
    return current_states([r for r in rows if r.work_key == chosen.state_key])


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


def read_tf(lake: Lake, vehicle: str, days: Iterable[str]) -> TransformTree:
    """The car's own tree above its sensors, from /tf_static of the latest of these days that has one."""
    tree = TransformTree()
    for row in next((rows for own in _ingested(lake, vehicle, days) if (rows := own.get(TF))), ()):
        tree.add_transform(row["parent"], row["child"], transform_of_row(row))
    return tree


def read_frame_ids(lake: Lake, vehicle: str, days: Iterable[str]) -> dict[str, str]:
    """Frame of each sensor in the logs of the latest of these days, unless it has several."""
    for own in _ingested(lake, vehicle, days):
        known = own.get("frame_ids", {})
        names = {sensor: ids[0].lstrip("/") for sensor, ids in known.items() if len(ids) == 1}
        if names:
            is_sound = len(set(names.values())) == len(names) and all(map(is_frame, names.values()))
            return names if is_sound else {}
    return {}


def _ingested(lake: Lake, vehicle: str, days: Iterable[str]) -> Iterator[Mapping[str, Any]]:
    """What ingest noted of these days, the latest first."""
    for day in sorted(days, reverse=True):
        try:
            manifest = ingested(lake, Partition(vehicle, day))
        except ContractError as err:  # damaged
            lake.damage.append(str(err))
            continue
        if manifest is not None:
            yield manifest.extra


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
