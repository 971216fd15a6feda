"""Numbers of a fleet's control charts, which the page draws when a vehicle is opened.

Ten thousand vehicles have 180,000 charts: hundreds of megabytes as drawings, some ten kilobytes per vehicle
as numbers, in files of a few dozen vehicles each.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.report.verdicts import ChartVerdicts, FleetVerdicts
from pipeline.report.window import FleetWindow
from pipeline.rig.graph import Edge, edge_order
from pipeline.rig.se3 import change_between
from schemas.calibrations import DOF_NAMES
from schemas.service_events import ServiceEvent

__all__ = ["charted_edges", "fleet_charts"]

# Of a value as the page gets it: 1e-4 deg and 0.1 mm are a hundredth of the smallest sigma of a day.
_PER_UNIT = 1e4
_STATUS_LETTERS = "ahr"  # of schemas.calibrations.STATUSES
_DOFS = len(DOF_NAMES)


def charted_edges(window: FleetWindow, verdicts: FleetVerdicts) -> tuple[Edge, ...]:
    """Edges that any record or chart is of, in order."""
    return tuple(sorted({*window.edges, *verdicts.charts.edges}, key=edge_order))


def fleet_charts(
    window: FleetWindow, verdicts: FleetVerdicts, events: Sequence[ServiceEvent] = ()
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every audited vehicle with its charts, for `templates/fleet.js`.

    A chart is [edge, dof, status, limit, start, values, sigmas]: places in `charted_edges`, DOF_NAMES and
    DRIFT_STATUSES; the limit, and per day value and sigma, in 1e-4 deg or 1e-4 m, null where the day does not
    say; the start as days of the calendar (first, earliest, latest), null where nothing changed. Values are
    relative to the level before the change, or since the last service event. `days` are ordinals of the
    calendar; `pairs` has a letter per edge and day: accepted, held, refused, "." none; `events` are
    [day, text, edges that it restarts].
    """
    first = _spans(window.owner, len(window.vehicles))
    of_chart = _spans(verdicts.charts.owner, len(verdicts.vehicles))
    place = {vehicle: v for v, vehicle in enumerate(window.vehicles)}
    by_vehicle: dict[str, list[ServiceEvent]] = {}
    for event in events:
        by_vehicle.setdefault(event.vehicle, []).append(event)
    values = _values(window, verdicts, by_vehicle)
    edges = charted_edges(window, verdicts)
    place_of = [
        np.array([edges.index(e) for e in own], np.int64) for own in (window.edges, verdicts.charts.edges)
    ]
    for c, vehicle in enumerate(verdicts.vehicles):
        v = place.get(vehicle)
        if v is not None:
            rows, charts = slice(*first[v : v + 2]), slice(*of_chart[c : c + 2])
            shown = place_of[0][window.edge[rows]], place_of[1][verdicts.charts.edge[charts]]
            numbers = _vehicle(window, verdicts.charts, values, (rows, charts), shown, len(edges))
            done = [
                [dt.date.fromisoformat(e.day).toordinal(), e.in_words, _restarted(e, edges)]
                for e in by_vehicle.get(vehicle, ())
            ]
            yield vehicle, numbers | {"events": done}


def _restarted(event: ServiceEvent, edges: Sequence[Edge]) -> list[int]:
    """Places of the edges that an event may have moved."""
    return [k for k, edge in enumerate(edges) if event.touches([sensor.name for sensor in edge.sensors])]


def _vehicle(
    window: FleetWindow,
    verdicts: ChartVerdicts,
    values: Float[np.ndarray, "N 6"],
    of: tuple[slice, slice],
    shown: tuple[Int[np.ndarray, " R"], Int[np.ndarray, " C"]],
    edges: int,
) -> dict[str, Any]:
    """Numbers of one vehicle.

    Args:
        values: of all records.
        of: its rows among the records, and among the charts.
        shown: places of their edges on the page.
    """
    (rows, charts), (pair, of_chart) = of, shown
    days, column = np.unique(window.day[rows], return_inverse=True)
    letters = np.full((edges, len(days)), ".")
    letters[pair, column] = np.array(list(_STATUS_LETTERS))[window.status[rows]]
    scale = np.repeat([np.degrees(_PER_UNIT), _PER_UNIT], 3)
    grid = np.full((2, edges, len(days), _DOFS), np.nan)
    grid[0, pair, column] = values[rows] * scale
    grid[1, pair, column] = window.sigma[rows] * scale
    seen = np.isfinite(grid).all(axis=0)
    told = np.round(np.where(seen, grid, 0.0)).astype(np.int64).astype(object)
    told[:, ~seen] = None
    listed = []
    for k, p in zip(range(charts.start, charts.stop), of_chart.tolist(), strict=True):
        dof = int(verdicts.dof[k])
        value, sigma = told[:, p, :, dof].tolist()
        start = verdicts.start[k].tolist()
        limit = round(float(verdicts.limit[k] * scale[dof]))
        listed.append([p, dof, int(verdicts.status[k]), limit, start if start[0] else None, value, sigma])
    return {"days": days.tolist(), "pairs": ["".join(row) for row in letters], "charts": listed}


def _values(
    window: FleetWindow, verdicts: FleetVerdicts, events: Mapping[str, Sequence[ServiceEvent]]
) -> Float[np.ndarray, "N 6"]:
    """Changes [rad, m] of every record from its edge's level before the change; not finite where it has none.

    The level is that since the last service event, if there are days since.
    """
    seen = np.isfinite(window.sigma) & window.observable
    group = window.owner * len(window.edges) + window.edge
    origin = _first_of_each(group, seen.any(axis=1))[group]
    change = np.full(seen.shape, np.nan)
    there = origin >= 0
    change[there] = change_between(window.T[origin[there]], window.T[there])
    change[~seen] = np.nan
    start = _starts(window, verdicts)[group]
    weight = np.where(seen & (window.day[:, None] < start), window.sigma, np.inf) ** -2.0
    groups = int(group.max(initial=-1)) + 1
    level = np.zeros((groups, _DOFS))
    since = np.where((window.day > _restarts(window, events)[group])[:, None], weight, 0.0)
    for k in range(_DOFS):
        again = np.bincount(group, since[:, k], groups)[group] > 0
        weight[again, k] = since[again, k]
        total = np.bincount(group, weight[:, k], groups)
        moment = np.bincount(group, weight[:, k] * np.where(seen[:, k], change[:, k], 0.0), groups)
        level[:, k] = np.divide(moment, total, out=np.zeros(groups), where=total > 0)
    return change - level[group]


def _restarts(window: FleetWindow, events: Mapping[str, Sequence[ServiceEvent]]) -> Int[np.ndarray, " G"]:
    """Day of the last service event per vehicle and edge; 0 if there was none."""
    restarts = np.zeros((len(window.vehicles), len(window.edges)), np.int64)
    for v, vehicle in enumerate(window.vehicles):
        for event in events.get(vehicle, ()):
            touched = _restarted(event, window.edges)
            day = dt.date.fromisoformat(event.day).toordinal()
            restarts[v, touched] = np.maximum(restarts[v, touched], day)
    return restarts.ravel()


def _starts(window: FleetWindow, verdicts: FleetVerdicts) -> Int[np.ndarray, "G 6"]:
    """First day with the new value per vehicle and edge, and DoF; far in the future where nothing changed."""
    starts = np.full((len(window.vehicles) * len(window.edges), _DOFS), np.iinfo(np.int64).max)
    place = {vehicle: v for v, vehicle in enumerate(window.vehicles)}
    own = np.array([place.get(vehicle, -1) for vehicle in verdicts.vehicles], np.int64)
    charts = verdicts.charts
    owner = own[charts.owner] if len(own) else charts.owner
    there = {edge: place for place, edge in enumerate(window.edges)}
    edge = np.array([there.get(e, -1) for e in charts.edges], np.int64)[charts.edge]
    changed = (owner >= 0) & (edge >= 0) & (charts.start[:, 0] > 0)
    rows = owner[changed] * len(window.edges) + edge[changed]
    starts[rows, charts.dof[changed]] = charts.start[changed, 0]
    return starts


def _first_of_each(group: Int[np.ndarray, " N"], usable: Bool[np.ndarray, " N"]) -> Int[np.ndarray, " G"]:
    """The first usable row of each group, -1 where it has none; rows of a group are in order of day."""
    first = np.full(int(group.max(initial=-1)) + 1, -1)
    rows = np.flatnonzero(usable)[::-1]
    first[group[rows]] = rows
    return first


def _spans(owner: Int[np.ndarray, " N"], count: int) -> list[int]:
    """Where each owner's rows begin, and where the last one's end; rows are in order of owner."""
    return [int(i) for i in np.searchsorted(owner, np.arange(count + 1))]
