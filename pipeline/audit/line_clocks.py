"""Time offsets of the last days of a model line, by edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.audit.line_records import release_of
from pipeline.fleet_model.answers import DIFFERS_SIGMAS
from pipeline.fleet_model.clocks import clock_step, line_clock, of_vehicles
from pipeline.rig.edges import edges_of_rows
from pipeline.rig.graph import Edge
from pipeline.store.columns import ordinals
from pipeline.store.current import current_rows
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.versions import CODE_VERSION

__all__ = ["clocks_of_lines"]

_DAYS = 14  # clocks step with a release; older days say little of tonight's
_COLUMNS = ("status", "time_offset_s", "time_offset_sigma_s", "code_version")
_LEAST_SIGMA_S = 1e-4  # of a day: no log times its sensors better


def clocks_of_lines(
    lake: Lake, method: str, last: str, line_of: Callable[[str], str]
) -> dict[tuple[str, Edge], dict[str, Any]]:
    """Columns of `fleet_model` about clocks, by line and edge, where enough vehicles estimate an offset."""
    table = read_columns(lake, CALIBRATIONS, _COLUMNS, first=days_after(last, 1 - _DAYS), last=last)
    if table is None:
        return {}
    rows = current_rows(table.filter(pc.equal(table["method"], method)), CALIBRATIONS)
    timed = pc.and_(pc.is_valid(rows["time_offset_s"]), pc.is_valid(rows["time_offset_sigma_s"]))
    rows = rows.filter(pc.and_(timed, pc.not_equal(rows["status"], "refused")))
    own = [release_of(v or "") == release_of(CODE_VERSION) for v in rows["code_version"].to_pylist()]
    rows = rows.filter(pa.array(own, pa.bool_()))
    if not rows.num_rows:
        return {}
    edges, edge = edges_of_rows(rows)
    names = rows["vehicle"].to_pylist()
    vehicles = sorted(set(names))
    place = {name: k for k, name in enumerate(vehicles)}
    of, lines = np.array([place[n] for n in names], np.int64), np.array([line_of(n) for n in vehicles])
    value, sigma = rows["time_offset_s"].to_numpy(), rows["time_offset_sigma_s"].to_numpy()
    sigma, day = np.maximum(sigma, _LEAST_SIGMA_S), ordinals(rows["day"])
    found = {}
    for line in sorted({*lines.tolist()} - {""}):
        for k, name in enumerate(edges):
            r = np.flatnonzero((edge == k) & (lines[of] == line))
            columns = _columns(of[r], day[r], value[r], sigma[r], vehicles)
            if columns:
                found[line, name] = columns
    return found


def _columns(
    of: np.ndarray, day: np.ndarray, value: np.ndarray, sigma: np.ndarray, vehicles: Sequence[str]
) -> dict[str, Any]:
    who, mean, known = of_vehicles(of, value, sigma)
    clock = line_clock(mean, known)
    if clock is None:
        return {}
    step = clock_step(of, day, value, sigma)
    return {
        "clock_mean_s": clock.mean,
        "clock_sigma_s": clock.sigma,
        "clock_scatter_s": clock.scatter,
        "clock_outside": [vehicles[who[k]] for k in np.flatnonzero(clock.distance > DIFFERS_SIGMAS)],
        "clock_step_s": None if step is None else step[0],
        "clock_step_sigma_s": None if step is None else step[1],
    }
