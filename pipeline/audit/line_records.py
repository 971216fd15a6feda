"""Records that model lines count: edges, and poses of adjusted rigs, with the priors that are in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

from pipeline.audit.estimates import COLUMNS, Estimates, estimates_at, faults_of
from pipeline.geometry.se3 import from_quaternion
from pipeline.rig.edges import edge_order, edges_of_rows
from pipeline.rig.graph import Edge, RigPose, Sensor, is_one_of_each
from pipeline.store.columns import matrices
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import count_of_days, read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.columns import POSE_COLUMNS, TableSchema
from schemas.poses import POSES
from schemas.versions import CODE_VERSION

__all__ = ["Asked", "LineRecords", "read_line_records", "release_of"]

_PRIOR = tuple(f"prior_{n}" for n in POSE_COLUMNS)
_UNSURE = ("diagnostics.unsure_only", "diagnostics.few_only")
_ROUNDING = 1e-3  # of a quaternion's length
_LEAST = 1e-9  # eigenvalue of a correlation matrix: with less a covariance knows a direction exactly
_AT_A_TIME = 10_000  # records in memory together: they take 12 kB each while they are read
_COUNTED_DAYS = 28  # days whose records are counted together
_OF_POSES = {c.name for c in POSES.columns}


@dataclass(frozen=True)
class Asked:
    """What is read: days of a method, later ones than `last` are faults; of some vehicles, or asserted later."""

    method: str
    last: str
    vehicles: frozenset[str] | None = None
    asserted_after: str | None = None


@dataclass(frozen=True, eq=False)
class LineRecords:
    """Current records of one table, in order of vehicle, day and edge.

    Args:
        usable: records of this release that are accepted, or held for nothing but their sigma, or too few frames
            or scenes.
        asserted: when each was.
        other_releases: of records that are not usable for that alone: their last days, by vehicle and edge.
    """

    records: Estimates
    prior: Float[np.ndarray, "N 4 4"]
    prior_covariance: Float[np.ndarray, "N 6 6"]
    usable: Bool[np.ndarray, " N"]
    asserted: list[str]
    other_releases: dict[tuple[str, Edge], dict[str, int]]

    def keys(self) -> list[tuple[str, Edge]]:
        """Vehicle and edge of each record."""
        names, edges = self.records.vehicles, self.records.edges
        of = zip(self.records.owner.tolist(), self.records.edge.tolist(), strict=True)
        return [(names[v], edges[e]) for v, e in of]


def release_of(version: str) -> str:
    """Releases that differ in the third number err alike."""
    return ".".join(version.split(".")[:2])


def read_line_records(lake: Lake, first: str, last: str, asked: Asked) -> Iterator[LineRecords]:
    """Edges, then poses of rigs that have more than one sensor of a kind, from `first` to `last`.

    Parts of whole days, in order; days of many records come in parts of whole vehicles.
    """
    for schema in (CALIBRATIONS, POSES):
        for begin, end, vehicles in _parts(lake, schema, (first, last), asked):
            read = _read(lake, schema, (begin, end), vehicles, asked)
            if read is not None:
                yield read


def _read(
    lake: Lake, schema: TableSchema, days: tuple[str, str], vehicles: frozenset[str] | None, asked: Asked
) -> LineRecords | None:
    is_of_poses = schema is POSES
    more = ("sensor", "kind", "reference", "unsure_only") if is_of_poses else _UNSURE
    own = tuple(c for c in COLUMNS if c in _OF_POSES or not is_of_poses)
    table = read_columns(
        lake, schema, (*own, *_PRIOR, "prior_covariance", "code_version", *more),
        first=days[0], last=days[1], vehicle=vehicles, asserted_after=asked.asserted_after,
    )  # fmt: skip
    if table is None:
        return None
    found = current_rows(table.filter(pc.equal(table["method"], asked.method)), schema)
    edges, edge = _poses_of(found) if is_of_poses else edges_of_rows(found)
    found, edge = found.filter(pa.array(edge >= 0)), edge[edge >= 0]  # an unknown pair is not counted
    return _in_order(_with_missing(found) if is_of_poses else found, edges, edge, schema, asked.last)


def _parts(
    lake: Lake, schema: TableSchema, days: tuple[str, str], asked: Asked
) -> Iterator[tuple[str, str, frozenset[str] | None]]:
    """Days, and some of the vehicles or None for all asked ones, with few enough records for the memory."""
    begin, last = days
    while begin <= last:
        end = min(days_after(begin, _COUNTED_DAYS - 1), last)
        found = count_of_days(
            lake, schema, first=begin, last=end, vehicle=asked.vehicles, asserted_after=asked.asserted_after
        )
        for first, until, records in _spans_of(found):
            parts = -(-records // _AT_A_TIME)
            if parts == 1:
                yield first, until, asked.vehicles
                continue
            of_day = read_columns(
                lake, schema, (), first=first, last=first, vehicle=asked.vehicles,
                asserted_after=asked.asserted_after,
            )  # fmt: skip
            names = sorted(pc.unique(of_day["vehicle"]).to_pylist()) if of_day is not None else []
            for part in np.array_split(np.array(names, object), parts):
                yield first, until, frozenset(part.tolist())
        begin = days_after(end, 1)


def _spans_of(records: Mapping[str, int]) -> Iterator[tuple[str, str, int]]:
    """First and last days of spans with at most `_AT_A_TIME` records, or of one day, and their records."""
    first, until, together = "", "", 0
    for day, number in sorted(records.items()):
        if first and together + number > _AT_A_TIME:
            yield first, until, together
            first = ""
        first, until, together = (first, day, together + number) if first else (day, day, number)
    if first:
        yield first, until, together


def _in_order(
    found: pa.Table,
    edges: tuple[Edge, ...],
    edge: Int[np.ndarray, " N"],
    schema: TableSchema,
    last: str,
) -> LineRecords:
    by = [(name, "ascending") for name in ("vehicle", "day", "edge")]
    order = pc.sort_indices(found.append_column("edge", pa.array(edge)), by)
    found, edge = found.take(order), edge[np.asarray(order)]
    records = estimates_at(found, edges, edge)
    pose = np.stack([found[name].cast(pa.float64()).to_numpy() for name in _PRIOR], axis=1)
    P = matrices(found["prior_covariance"])
    unit_length = np.abs((np.nan_to_num(pose[:, :4]) ** 2).sum(axis=1) - 1) < _ROUNDING
    known = unit_length & np.isfinite(pose).all(axis=1) & _is_positive(P) & _is_positive(records.covariance)
    names = ("unsure_only",) if schema is POSES else _UNSURE
    unsure = np.any([pc.fill_null(found[n].cast(pa.float64()), 0.0).to_numpy() > 0 for n in names], axis=0)
    usable = records.usable & (records.accepted | unsure) & records.has_common & known
    usable[list(faults_of(records, last))] = False
    versions = [release_of(v or "") for v in found["code_version"].to_pylist()]
    is_own = np.array([v == release_of(CODE_VERSION) for v in versions], bool)
    prior = np.broadcast_to(np.eye(4), (len(known), 4, 4)).copy()
    prior[known] = from_quaternion(pose[known, :4], pose[known, 4:])
    read = LineRecords(records, prior, P, usable & is_own, found["asserted_at"].to_pylist(), {})
    if not is_own.all():
        keys = read.keys()
        for r in np.flatnonzero(usable & ~is_own).tolist():
            of = read.other_releases.setdefault(keys[r], {})
            of[versions[r]] = max(of.get(versions[r], 0), int(records.day[r]))
    return read


def _is_positive(covariance: Float[np.ndarray, "N 6 6"]) -> Bool[np.ndarray, " N"]:
    """Whether covariances are finite, and positive definite beyond rounding."""
    finite = np.isfinite(covariance).all(axis=(1, 2))
    C = np.where(finite[:, None, None], covariance, np.eye(6))
    diagonal = np.einsum("nii->ni", C)
    finite &= (diagonal > 0).all(axis=1)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    least = np.linalg.eigvalsh(C * scale[:, :, None] * scale[:, None, :])[:, 0] if len(C) else np.zeros(0)
    return np.asarray(finite & (least > _LEAST))


def _poses_of(rows: pa.Table) -> tuple[tuple[Edge, ...], Int[np.ndarray, " N"]]:
    """The pose that each row is of, or -1: references, and rigs whose records are of the adjusted poses already."""
    names = ("vehicle", "day", "sensor", "kind", "reference")
    values = list(zip(*(rows[name].to_pylist() for name in names), strict=True))
    kinds: dict[tuple[str, str], dict[str, str]] = {}
    for vehicle, day, sensor, kind, _ in values:
        kinds.setdefault((vehicle, day), {})[sensor] = kind
    of_rig = {
        key: not is_one_of_each([Sensor(name, kind) for name, kind in own.items()])  # type: ignore[arg-type]
        for key, own in kinds.items()
    }
    found: list[RigPose | None] = []
    for vehicle, day, sensor, kind, reference in values:
        own = kinds[vehicle, day]
        is_pose = of_rig[vehicle, day] and sensor != reference and reference in own
        found.append(RigPose(Sensor(reference, own[reference]), Sensor(sensor, kind)) if is_pose else None)  # type: ignore[arg-type]
    edges = tuple(sorted({pose for pose in found if pose is not None}, key=edge_order))
    place = {pose: k for k, pose in enumerate(edges)}
    return edges, np.array([-1 if pose is None else place[pose] for pose in found], np.int64)


def _with_missing(poses: pa.Table) -> pa.Table:
    """Rows of poses with the columns that records of edges say besides, empty."""
    for name in COLUMNS:
        if name not in _OF_POSES:
            kind = pa.binary() if name == "half_days" else pa.float64()
            poses = poses.append_column(name, pa.nulls(poses.num_rows, kind))
    return poses
