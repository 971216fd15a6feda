"""The last days of a whole fleet as columns: input of the fleet page and its charts.

Ten thousand vehicles have a million records in four weeks: gigabytes as rows, some hundred megabytes as
columns.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float, Int

from pipeline.rig.graph import Edge, edges_of_rows
from pipeline.rig.kinds import EDGE_KINDS
from pipeline.rig.se3 import change_covariance, from_quaternion
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, days_after, months_before
from pipeline.store.records import first_day, last_day, read_columns
from pipeline.store.rows import known_rows, matrices, observable_dofs, ordinals, places, there
from schemas.calibrations import CALIBRATIONS, STATUSES
from schemas.columns import POSE_COLUMNS

__all__ = ["FEWEST_DAYS", "FleetWindow", "read_window"]

# Of a vehicle, however far back they lie: as many as its charts reach back to (audit/days.py).
FEWEST_DAYS = 14
_MONTHS_BACK = 4  # and no further, as charts do (audit/history.py)
_COLUMNS = ("status", *POSE_COLUMNS, "covariance", "observable", "code_version")


@dataclass(frozen=True, eq=False)
class FleetWindow:
    """Current records of a method, in order of vehicle, day and edge.

    Args:
        owner: vehicle of each record, as an index.
        day: ordinals of the calendar.
        edges: edges of all records, in order.
        edge: edge of each record, as an index.
        T: T_parent_child; not finite if the day was refused.
        sigma: sigmas of (rotation vector [rad], origin [m]); not finite if the day was refused.
        observable: per DoF, whether the day determined it.
    """

    vehicles: list[str]
    edges: tuple[Edge, ...]
    owner: Int[np.ndarray, " N"]
    day: Int[np.ndarray, " N"]
    edge: Int[np.ndarray, " N"]
    status: Int[np.ndarray, " N"]
    T: Float[np.ndarray, "N 4 4"]
    sigma: Float[np.ndarray, "N 6"]
    observable: Bool[np.ndarray, "N 6"]
    work_key: list[str]
    code_versions: list[str]

    def vehicle_days(self) -> dict[tuple[str, str], list[str]]:
        """Work keys of every vehicle-day's records, in order of vehicle and day."""
        found: dict[tuple[str, str], list[str]] = {}
        name = {day: dt.date.fromordinal(day).isoformat() for day in np.unique(self.day).tolist()}
        for owner, day, key in zip(self.owner.tolist(), self.day.tolist(), self.work_key, strict=True):
            found.setdefault((self.vehicles[owner], name[day]), []).append(key)
        return found


def read_window(lake: Lake, method: str, window_days: int, latest: str) -> FleetWindow:
    """Records of the last `window_days` days; vehicles that drive rarely get their older records too.

    Args:
        window_days: days of the calendar.
        latest: last day; later days are in the future, and left out.
    """
    last = last_day(lake, CALIBRATIONS)
    if last is None:
        return _window_of(None)
    first = days_after(min(last, latest), 1 - window_days)
    found = _read(lake, method, first, latest)
    if found is None:  # another method's records are newer by more than a window, or all of them are to come
        found = _read(lake, method, None, latest)
        if found is None:
            return _window_of(None)
        first = days_after(pc.max(found["day"]).as_py(), 1 - window_days)
        found = found.filter(pc.greater_equal(found["day"], first))
    parts, begun = [found], first_day(lake, CALIBRATIONS) or first
    for month, end in months_before(first, _MONTHS_BACK):
        rare = _rare(parts)
        if not rare or end < begun:
            break
        more = _read(lake, method, month, end, rare)
        parts += [] if more is None else [more]
    return _window_of(pa.concat_tables(parts))


def _read(
    lake: Lake, method: str, first: str | None, last: str | None, vehicles: Collection[str] | None = None
) -> pa.Table | None:
    found = read_columns(lake, CALIBRATIONS, _COLUMNS, first=first, last=last)
    if found is None:
        return None
    chosen = pc.equal(found["method"], method)
    if vehicles is not None:
        chosen = pc.and_(chosen, pc.is_in(found["vehicle"], pa.array(sorted(vehicles))))
    found = found.filter(chosen)
    return found if found.num_rows else None


def _rare(parts: list[pa.Table]) -> list[str]:
    """Vehicles with too few days in the window."""
    keys = pa.concat_tables([part.select(["vehicle", "day"]) for part in parts])
    days = keys.group_by(["vehicle"]).aggregate([("day", "count_distinct")])
    few: list[str] = days.filter(pc.less(days["day_count_distinct"], FEWEST_DAYS))["vehicle"].to_pylist()
    return few


def _window_of(table: pa.Table | None) -> FleetWindow:
    found = CALIBRATIONS.arrow_schema().empty_table() if table is None else table
    found = current_rows(found, CALIBRATIONS)
    # What no release writes is not drawn; the audit names such records.
    found = known_rows(found, {"pair": EDGE_KINDS, "status": STATUSES})
    edges, edge = edges_of_rows(found)
    names = found["vehicle"].combine_chunks().dictionary_encode()
    T, sigma = _estimates(found)
    return FleetWindow(
        names.dictionary.to_pylist(),  # rows are in order of vehicle, and so is what they are first met in
        edges,
        np.asarray(names.indices).astype(np.int64),
        ordinals(found["day"]),
        edge,
        places(found["status"], STATUSES),
        T,
        sigma,
        observable_dofs(found["observable"]),
        found["work_key"].to_pylist(),
        sorted(set(found["code_version"].unique().to_pylist())),
    )


def _estimates(found: pa.Table) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "N 6"]]:
    """Poses and the sigmas of quantities that a mechanic can measure; not finite for records without them."""
    pose = np.stack([found[name].to_numpy() for name in POSE_COLUMNS], axis=1)
    covariance = matrices(found["covariance"])
    is_there = np.isfinite(pose).all(axis=1) & there(found["covariance"])
    T, sigma = np.full((len(pose), 4, 4), np.nan), np.full((len(pose), 6), np.nan)
    if is_there.any():
        T[is_there] = from_quaternion(pose[is_there, :4], pose[is_there, 4:])
        of_change = change_covariance(T[is_there], covariance[is_there])
        sigma[is_there] = np.sqrt(np.maximum(np.diagonal(of_change, axis1=1, axis2=2), 0.0))
    return T, sigma
