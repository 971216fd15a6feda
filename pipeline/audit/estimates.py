"""Records of a fleet as columns, each day used as far as its checks allow."""

from __future__ import annotations

import datetime as dt
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

from pipeline.audit.days import PairDays, pair_days
from pipeline.rig.graph import Edge, edge_order, edges_of_rows
from pipeline.rig.se3 import change_jacobian, changed, from_quaternion
from pipeline.store.current import current_rows
from pipeline.store.rows import matrices, observable_dofs, ordinals, places, there
from schemas.calibrations import CALIBRATIONS, STATUSES
from schemas.columns import POSE_COLUMNS

__all__ = [
    "COLUMNS", "Estimates", "day_name", "days_of", "estimates_at", "estimates_of", "faults_of",
    "is_covariance", "is_rigid", "joined",
]  # fmt: skip

_ROUNDING = 1e-3  # of what should be 1
_SHIFTS = tuple(f"diagnostics.holdout_{n}_shift_rad" for n in ("azimuth", "elevation"))
_DISPROVED = "diagnostics.disproved"
# Columns of a record beside its identity.
COLUMNS = (
    "status",
    *POSE_COLUMNS,
    "covariance",
    "common_covariance",
    "observable",
    *(f"own_{name}" for name in (*POSE_COLUMNS, "covariance", "common_covariance", "observable")),
    "half_days",
    "targets_m",
    _DISPROVED,
    *_SHIFTS,
)
_ACCEPTED, _HELD, _REFUSED = (STATUSES.index(name) for name in ("accepted", "held", "refused"))


@dataclass(frozen=True, eq=False)
class Estimates:
    """Current records of one method in order of vehicle, day and edge; missing numbers of a record are not finite.

    As rows, a year of a fleet would take gigabytes; here a record takes 700 bytes.

    Args:
        owner: vehicle of each record, as an index.
        day: ordinals of the calendar.
        edges: edges of all records, in order.
        edge: edge of each record, as an index; -1: none.
        pose: T_parent_child as quaternion (scalar first) and translation [m].
        has_estimate: neither pose nor covariance is null.
        common: part of the covariance from errors common to all days.
        has_common: False if the method does not tell it apart.
        disproved: a check shows that the pose is wrong.
        shown_wrong_rad: angular error that the checks of a held record found.
        half_days: for a day within which a sensor moved, changes from the pose and their sigmas, by part of
            the day.
        targets: targets of its sigmas, in the child's frame; not finite if it has none.
    """

    vehicles: list[str]
    edges: tuple[Edge, ...]
    owner: Int[np.ndarray, " N"]
    day: Int[np.ndarray, " N"]
    edge: Int[np.ndarray, " N"]
    status: Int[np.ndarray, " N"]
    pose: Float[np.ndarray, "N 7"]
    has_estimate: Bool[np.ndarray, " N"]
    covariance: Float[np.ndarray, "N 6 6"]
    common: Float[np.ndarray, "N 6 6"]
    has_common: Bool[np.ndarray, " N"]
    observable: Bool[np.ndarray, "N 6"]
    disproved: Bool[np.ndarray, " N"]
    shown_wrong_rad: Float[np.ndarray, " N"]
    half_days: Float[np.ndarray, "N 2 2 6"]
    targets: Float[np.ndarray, "N 3 3"]
    work_key: pa.Array

    def at(self, rows: slice | np.ndarray) -> Estimates:
        """A selection of the records, in the same order."""
        keys = self.work_key[rows] if isinstance(rows, slice) else self.work_key.take(pa.array(rows))
        return replace(self, work_key=keys, **{name: getattr(self, name)[rows] for name in _PER_RECORD})

    def of(self, vehicle: str) -> Estimates:
        """One vehicle's records."""
        begin = bisect_left(self.vehicles, vehicle)
        if begin == len(self.vehicles) or self.vehicles[begin] != vehicle:
            return self.at(slice(0, 0))
        return self.at(slice(*np.searchsorted(self.owner, [begin, begin + 1])))

    def is_of(self, edge: Edge) -> Bool[np.ndarray, " N"]:
        """Records of an edge."""
        return self.edge == self.edges.index(edge) if edge in self.edges else np.zeros(len(self.edge), bool)

    def own_edges(self) -> list[Edge]:
        """Edges of these records, sorted."""
        return [self.edges[e] for e in np.unique(self.edge).tolist() if e >= 0]

    @property
    def accepted(self) -> Bool[np.ndarray, " N"]:
        """Records to use."""
        return self.status == _ACCEPTED

    @property
    def refused(self) -> Bool[np.ndarray, " N"]:
        """Days without an estimate."""
        return self.status == _REFUSED

    @property
    def usable(self) -> Bool[np.ndarray, " N"]:
        """Records with a pose that no check disproved; a wrong minimum was 0.7 m off at a sigma of millimetres."""
        return ~self.refused & self.has_estimate & ~self.disproved

    def transforms(self) -> Float[np.ndarray, "N 4 4"]:
        """T_parent_child; not finite for a record without a pose."""
        return from_quaternion(self.pose[:, :4], self.pose[:, 4:])

    def keys(self) -> list[str]:
        """Work keys, each once, in order."""
        return sorted(set(self.work_key.to_pylist()))


_PER_RECORD = [f.name for f in fields(Estimates) if f.name not in ("vehicles", "edges", "work_key")]


def estimates_of(table: pa.Table | None) -> Estimates:
    """Current records of a table that has COLUMNS and the key columns; None = no records."""
    if table is None:
        table = CALIBRATIONS.arrow_schema().empty_table()
        for name in (_DISPROVED, *_SHIFTS):
            table = table.append_column(name, pa.array([], pa.float64()))
    found = current_rows(table, CALIBRATIONS)
    return estimates_at(found, *edges_of_rows(found))


def estimates_at(found: pa.Table, edges: tuple[Edge, ...], edge: Int[np.ndarray, " N"]) -> Estimates:
    """Current rows, in order of vehicle, as columns; `edge` is -1 for a row without edge."""
    names = found["vehicle"].combine_chunks().dictionary_encode()
    owner, day = np.asarray(names.indices).astype(np.int64), ordinals(found["day"])
    order = np.lexsort((edge, day, owner))  # edges of a day side by side
    found = _own(found.take(pa.array(order)))
    pose = np.stack([found[name].to_numpy() for name in POSE_COLUMNS], axis=1)
    is_there = np.all([there(found[name]) for name in (*POSE_COLUMNS, "covariance")], axis=0)
    shifts = np.abs(np.stack([pc.fill_null(found[name], 0.0).to_numpy() for name in _SHIFTS], axis=1))
    worst = shifts.max(axis=1, initial=0.0)
    return Estimates(
        names.dictionary.to_pylist(),  # rows are in order of vehicle, and so is what they are first met in
        edges, owner[order], day[order], edge[order], places(found["status"], STATUSES), pose,
        is_there, matrices(found["covariance"]), matrices(found["common_covariance"]),
        there(found["common_covariance"]), observable_dofs(found["observable"]),
        pc.fill_null(found[_DISPROVED], 0.0).to_numpy() != 0.0, np.where(np.isfinite(worst), worst, 0.0),
        matrices(found["half_days"], (2, 2, 6)), matrices(found["targets_m"], (3, 3)),
        found["work_key"].combine_chunks(),
    )  # fmt: skip


def _own(found: pa.Table) -> pa.Table:
    """What each edge found alone: charts of edges need independent values, and adjusted ones share their errors."""
    is_there = pc.is_valid(found["own_covariance"])
    for name in (*POSE_COLUMNS, "covariance", "common_covariance", "observable"):
        k, own = found.column_names.index(name), found[f"own_{name}"]
        found = found.set_column(k, name, pc.if_else(is_there, own, found[name]))
    return found


def joined(parts: Sequence[Estimates]) -> Estimates:
    """Records of several disjoint parts combined, without vehicles that have no records."""
    vehicles = sorted({part.vehicles[v] for part in parts for v in np.unique(part.owner)})
    place = {vehicle: v for v, vehicle in enumerate(vehicles)}
    owner = np.concatenate(
        [np.array([place.get(v, -1) for v in part.vehicles], np.int64)[part.owner] for part in parts]
    )
    edges = tuple(sorted({e for part in parts for e in part.edges}, key=edge_order))
    edge = np.concatenate(
        [np.array([*(edges.index(e) for e in part.edges), -1], np.int64)[part.edge] for part in parts]
    )
    whole = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in _PER_RECORD
        if name not in ("owner", "edge")
    }
    keys = pa.concat_arrays([part.work_key for part in parts])
    found = Estimates(vehicles, edges, owner, edge=edge, work_key=keys, **whole)
    return found.at(np.lexsort((edge, found.day, owner)))


def days_of(records: Estimates, held_sigma_factor: float) -> dict[Edge, PairDays]:
    """Estimates by edge; refused and disproved days are gaps, sigmas of held days grow by the factor."""
    days, usable = {}, records.usable
    for edge in records.own_edges():
        rows = np.flatnonzero(usable & records.is_of(edge))
        if not len(rows):
            continue
        own = records.at(rows)
        # Without a common part, all of the covariance counts as varying.
        common = np.where(own.has_common[:, None, None], own.common, 0.0)
        covariance, held = own.covariance.copy(), ~own.accepted
        covariance[held] = common[held] + (covariance - common)[held] * held_sigma_factor**2
        T, cut = own.transforms(), np.isfinite(own.half_days).all(axis=(1, 2, 3))
        off = held & ~cut
        covariance[off, :3, :3] += np.eye(3) * own.shown_wrong_rad[off, None, None] ** 2
        if cut.any():
            T[cut], covariance[cut] = _since_it_moved(T[cut], covariance[cut], own.half_days[cut, 1])
        days[edge] = pair_days(own.day, T, covariance, common, own.observable, own.accepted)
    return days


def _since_it_moved(
    T: Float[np.ndarray, "N 4 4"], covariance: Float[np.ndarray, "N 6 6"], last: Float[np.ndarray, "N 2 6"]
) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "N 6 6"]]:
    """Estimates of the last part of days within which a sensor moved, because a mean of two poses matches neither.

    Later days are compared with that part, earlier days with the first one, so the change is on this day.
    """
    change, sigma = last[:, 0], last[:, 1]
    there = changed(T, change)
    to_twist = np.linalg.inv(change_jacobian(there))
    return there, covariance + to_twist @ (np.eye(6) * sigma[:, None] ** 2) @ to_twist.swapaxes(1, 2)


def faults_of(records: Estimates, latest_day: str) -> dict[int, str]:
    """Reasons why records cannot be used, by row; a refused day is no fault, a future one is."""
    future = records.day > dt.date.fromisoformat(latest_day).toordinal()
    unknown = (records.edge < 0) | (records.status < 0)
    looked_at = ~future & ~unknown & ~records.refused
    estimated = looked_at & records.has_estimate
    common = ~records.has_common | np.isfinite(records.common).all(axis=(1, 2))
    faults: dict[int, str] = {}
    for wrong, why in (
        (future, "is of a day in the future"),
        (unknown, "has a pair or a status that is unknown to this release"),
        (looked_at & ~records.has_estimate & (records.status != _HELD), "has no pose"),
        (estimated & ~is_rigid(records.pose), "has no rigid transform"),
        (estimated & ~is_covariance(records.covariance), "has no valid covariance"),
        (estimated & ~common, "has no covariance of the errors common to all days"),
    ):
        for row in np.flatnonzero(wrong).tolist():
            faults.setdefault(row, why)
    return dict(sorted(faults.items()))


def is_rigid(pose: Float[np.ndarray, "N 7"]) -> Bool[np.ndarray, " N"]:
    """Finite numbers, with a quaternion of length 1."""
    with np.errstate(invalid="ignore", over="ignore"):
        unit = np.abs((pose[:, :4] ** 2).sum(axis=1) - 1) <= _ROUNDING
    return np.asarray(unit & np.isfinite(pose).all(axis=1))


def is_covariance(C: Float[np.ndarray, "N 6 6"]) -> Bool[np.ndarray, " N"]:
    """Finite, with positive variances and no correlation beyond 1, at a fraction of what eigenvalues cost."""
    diagonal = np.einsum("nii->ni", C)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1 / np.sqrt(diagonal)
        sound = np.isfinite(C).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
        return np.asarray(
            sound & (np.abs(C * scale[:, :, None] * scale[:, None, :]) < 1 + _ROUNDING).all(axis=(1, 2))
        )


@lru_cache(maxsize=4096)
def day_name(ordinal: int) -> str:
    """Day as YYYY-MM-DD from its ordinal in the calendar."""
    return dt.date.fromordinal(ordinal).isoformat()
