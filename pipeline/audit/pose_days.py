"""Poses of a fleet's sensors over a window of days, as columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

from pipeline.audit.days import PairDays, pair_days
from pipeline.audit.estimates import is_covariance, is_rigid
from pipeline.audit.fusion import PoseDays
from pipeline.rig.graph import KINDS, Sensor
from pipeline.rig.se3 import from_quaternion
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake
from pipeline.store.records import read_columns
from pipeline.store.rows import matrices, observable_dofs, ordinals, there
from schemas.columns import POSE_COLUMNS
from schemas.poses import POSES

__all__ = ["SensorDays", "VehiclePoses", "read_poses"]

_PRIOR = tuple(f"prior_{name}" for name in POSE_COLUMNS)
_WORDS = ("vehicle", "day", "sensor", "kind", "reference", "status", "reason", "unsure_only")
_MOVED = "moved_in_day"


@dataclass(frozen=True, eq=False)
class SensorDays:
    """Days of one sensor's pose that nothing disproves: accepted, or held for nothing but a large sigma.

    Args:
        accepted: which of the days were accepted.
        targets: of the last of these days, in the reference's frame; None if it has none.
        prior: T_reference_sensor and covariance (left perturbation) before the last day; None if unknown.
        last: day, status and reason of the last row.
        held: days with a pose that do not count, in order of day.
        moved_within: days within which it or the reference moved, by the verdict, in order; they do not count either.
    """

    poses: PoseDays
    accepted: Bool[np.ndarray, " N"]
    observable: Bool[np.ndarray, "N 6"]
    work_keys: tuple[str, ...]
    targets: Float[np.ndarray, "3 3"] | None
    prior: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]] | None
    last: tuple[str, str, str]
    held: PoseDays
    moved_within: Int[np.ndarray, " M"]

    def since(self, first: int) -> SensorDays:
        """The days from an ordinal on."""
        rows = np.flatnonzero(self.poses.day >= first)
        keys = tuple(self.work_keys[k] for k in rows.tolist())
        return replace(
            self,
            poses=self.poses.at(rows),
            accepted=self.accepted[rows],
            observable=self.observable[rows],
            work_keys=keys,
        )

    def charted(self) -> PairDays:
        """The days as the charts have them."""
        p = self.poses
        return pair_days(p.day, p.T, p.covariance, p.common, self.observable, self.accepted)


@dataclass(frozen=True, eq=False)
class VehiclePoses:
    """Poses of one vehicle: its sensors without the reference, and days whose poses refer to another sensor."""

    reference: Sensor
    sensors: Mapping[Sensor, SensorDays]
    other_days: tuple[str, ...]


def read_poses(lake: Lake, method: str, first: str, last: str) -> dict[str, VehiclePoses]:
    """Current poses of every vehicle in a window of days."""
    asked = [*_WORDS, *POSE_COLUMNS, *_PRIOR]
    asked += ["faults", "covariance", "common_covariance", "prior_covariance", "observable", "targets_m"]
    table = read_columns(lake, POSES, asked, first=first, last=last)
    if table is None:
        return {}
    found = current_rows(table.filter(pc.equal(table["method"], method)), POSES)
    if not found.num_rows:
        return {}
    found = found.take(pc.sort_indices(found, [(name, "ascending") for name in ("vehicle", "sensor", "day")]))
    vehicles = found["vehicle"].to_pylist()
    bounds = [0, *(k for k in range(1, len(vehicles)) if vehicles[k] != vehicles[k - 1]), len(vehicles)]
    of_vehicle = {vehicles[a]: _vehicle(found.slice(a, b - a)) for a, b in pairwise(bounds)}
    return {name: own for name, own in of_vehicle.items() if own is not None}


def _vehicle(rows: pa.Table) -> VehiclePoses | None:
    """One vehicle's rows, in order of sensor and day; None if no row names the reference of its last day."""
    days, sensors, kinds, references = (
        rows[name].to_pylist() for name in ("day", "sensor", "kind", "reference")
    )
    reference = max(zip(days, references, strict=True))[1]
    kind = next((k for s, k in zip(sensors, kinds, strict=True) if s == reference), None)
    if kind is None:
        return None
    others = sorted({day for day, name in zip(days, references, strict=True) if name != reference})
    of_sensor: dict[str, list[int]] = {}
    for k, name in enumerate(sensors):
        if references[k] == reference != name:
            of_sensor.setdefault(name, []).append(k)
    own = {Sensor(name, kinds[at[-1]]): _sensor(rows.take(pa.array(at))) for name, at in of_sensor.items()}
    in_order = dict(sorted(own.items(), key=lambda item: (KINDS.index(item[0].kind), item[0].name)))
    return VehiclePoses(Sensor(reference, kind), in_order, tuple(others))


def _sensor(rows: pa.Table) -> SensorDays:
    status, unsure = rows["status"].to_pylist(), rows["unsure_only"].to_pylist()
    accepted = np.array([s == "accepted" for s in status])
    counts = accepted | np.array([s == "held" and bool(u) for s, u in zip(status, unsure, strict=True)])
    pose, prior = (_transforms(rows, names) for names in (POSE_COLUMNS, _PRIOR))
    C, B, P = (matrices(rows[name]) for name in ("covariance", "common_covariance", "prior_covariance"))
    knows_prior = np.isfinite(prior).all(axis=(1, 2)) & is_covariance(P)
    sound = np.isfinite(pose).all(axis=(1, 2)) & is_covariance(C) & np.isfinite(B).all(axis=(1, 2))
    kept, left = (np.flatnonzero(of & sound & knows_prior) for of in (counts, ~counts))
    days: Int[np.ndarray, " N"] = ordinals(rows["day"])
    targets, keys = matrices(rows["targets_m"], (3, 3)), rows["work_key"].to_pylist()
    seen = kept[np.isfinite(targets[kept]).all(axis=(1, 2))]
    known = np.flatnonzero(knows_prior)
    moved = np.array([_MOVED in (faults or ()) for faults in rows["faults"].to_pylist()], bool)
    last = tuple(str(rows[name][-1].as_py()) for name in ("day", "status", "reason"))
    return SensorDays(
        PoseDays(days[kept], pose[kept], C[kept], B[kept], prior[kept], P[kept]), accepted[kept],
        observable_dofs(rows["observable"])[kept], tuple(keys[k] for k in kept.tolist()),
        targets[seen[-1]] if len(seen) else None, (prior[known[-1]], P[known[-1]]) if len(known) else None,
        (last[0], last[1], last[2]), PoseDays(days[left], pose[left], C[left], B[left], prior[left], P[left]),
        days[moved & ~counts],
    )  # fmt: skip


def _transforms(rows: pa.Table, names: Sequence[str]) -> Float[np.ndarray, "N 4 4"]:
    """T of the rows; not finite where a row has none, or no rotation."""
    numbers = np.stack([rows[name].cast(pa.float64()).to_numpy() for name in names], axis=1)
    whole = np.all([there(rows[name]) for name in names], axis=0) & is_rigid(numbers)
    T = np.full((len(numbers), 4, 4), np.nan)
    T[whole] = from_quaternion(numbers[whole, :4], numbers[whole, 4:])
    return T
