"""Stage lines: what the vehicles of a model line share, and each vehicle's answer with it.

Runs after the audit, whose changes restart a vehicle's sums, and before the states, which may load the answers.
"""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.audit.days import DOFS
from pipeline.audit.estimates import day_name
from pipeline.audit.line_clocks import clocks_of_lines
from pipeline.audit.line_days import Counted, DaysOfLines, Drawing, Key
from pipeline.audit.line_records import release_of
from pipeline.audit.line_rows import LineOfEdge, as_answers, line_rows
from pipeline.audit.line_witnesses import reports_of_radars, witnesses_of
from pipeline.audit.pose_states import since_of_pose
from pipeline.audit.service import events_until, since_of
from pipeline.config import FleetConfig, config_hash
from pipeline.geometry.pose_columns import pose_of
from pipeline.rig.edges import edge_named, edge_order, line_edge, pair_of
from pipeline.rig.graph import Edge, RigPose, tie
from pipeline.stage_work import Records, Run, Task, Told, Window, Work
from pipeline.store.partitions import Lake, content_hash, days_after, last_possible_day, work_key
from pipeline.store.records import last_assertion, last_day, read_last, read_last_columns
from schemas.calibrations import CALIBRATIONS, DOF_NAMES
from schemas.drift import DRIFT, DriftFinding
from schemas.fleet_model import FLEET_MODEL, LINE_ANSWERS, FleetModelRow, LineAnswer
from schemas.service_events import ServiceEvent
from schemas.versions import CODE_VERSION

__all__ = ["work"]

# Older days count for less than a sixtieth, so that it hardly matters whether a night counts all days anew.
_DAYS_BACK = 180
_GONE_DAYS = 60  # a vehicle that was not seen for so long is of no line, as it has no state
_EDGE = ("pair", "parent_frame", "child_frame")
_OF_DRIFT = ("vehicle", *_EDGE, "dof", "status", "start_day", "start_day_latest", "moved_sensor",
             "day_scale", "day_autocorrelation")  # fmt: skip


def work(task: Task) -> Work:
    """Model of every line and edge with days, and an answer of each vehicle.

    Sums of the last night go on with the records that became current since.

    Raises:
        ContractError: a record was written with another schema version.
    """
    assert isinstance(task.of, Window), "lines are of all vehicles"
    fleet, method, lake = task.fleet, task.method or task.fleet.audit.method, task.lake
    last = task.of.last or min(last_day(lake, CALIBRATIONS) or "", last_possible_day())
    window = (days_after(last, 1 - _DAYS_BACK), last) if last else ("", "")
    settings = (fleet.audit, fleet.verify, fleet.fleet_model, {"to": last, "method": method})
    before = last_assertion(lake, LINE_ANSWERS, method)
    going_on = before is None or before.day <= last  # an earlier window is counted by itself

    def rows(run: Run) -> Generator[Records, None, None]:
        if not last:
            return
        # Read here, so that it is gone before the rows are written, when memory is fullest.
        counted = Counted.read(lake, method) if going_on else Counted()
        yield from _rows(task, method, window, counted, run)

    return Work(settings, rows, inputs=(), tell=_told, again=True)


def _rows(
    task: Task, method: str, window: tuple[str, str], counted: Counted, run: Run
) -> Generator[Records, None, None]:
    fleet, lake, last = task.fleet, task.lake, window[1]
    changes, noise = _of_audit(lake, method)
    events = events_until(lake, last)
    drawings, others = _of_last_night(lake, method)

    def restart(key: Key) -> str:
        return _since(key[1], events.get(key[0], ()), changes.get(key[0], ()), last)

    since, line_of = cache(restart), _line_of(fleet)
    run.progress(0, 0, "days")
    gone = days_after(last, 1 - _GONE_DAYS)
    counted.other_releases = {
        of: {r: d for r, d in own.items() if day_name(d) >= gone} for of, own in others.items()
    }
    days = DaysOfLines(lake, method, window, gone, line_of, since, noise.scale_of, drawings)
    counted = days.count(counted)
    told = _by_line(counted)
    config = config_hash(fleet.audit, fleet.verify, fleet.fleet_model, {"to": last, "method": method})
    witnesses, clocks = reports_of_radars(lake, method, window), clocks_of_lines(lake, method, last, line_of)
    for done, ((line, edge), keys) in enumerate(told.items()):
        run.progress(done, len(told), f"{line} {edge.name}")
        rows = np.array([counted.place[key] for key in keys], np.int64)
        about = {
            "day": last, "method": method, "line": line, "pair": pair_of(edge), "kinds": edge.kind,
            "parent_frame": edge.parent.name, "child_frame": edge.child.name, "code_version": CODE_VERSION,
        }  # fmt: skip
        vehicles = [vehicle for vehicle, _ in keys]
        of_edge = LineOfEdge(
            about, edge, vehicles, drawings[line, edge], counted.sums.at(rows),
            np.array([noise.scale_of(key) for key in keys]).reshape(-1, DOFS),
            np.array([noise.alike_of(key) for key in keys]).reshape(-1, DOFS),
            np.array([_is_remounted(edge, events.get(v, ())) for v in vehicles], bool),
            np.array([_has_changed(edge, changes.get(v, ())) for v in vehicles], bool),
            witnesses_of(witnesses, keys, since),
        )  # fmt: skip
        row, columns = line_rows(of_edge, fleet.fleet_model, fleet.verify)
        row = replace(row, **clocks.get((line, edge), {}))
        row = _with_other_releases(row, counted.other_releases.get((line, edge), {}))
        answers = as_answers(of_edge, columns, counted.columns(rows))
        answers = [_with_line_before(a, counted.changed_line.get(a.vehicle)) for a in answers]
        key = work_key("lines", CODE_VERSION, config, [content_hash([*answers, row])])
        yield Records([replace(r, work_key=key) for r in (*answers, row)], None, key, [])


def _line_of(fleet: FleetConfig) -> Callable[[str], str]:
    @cache
    def line(vehicle: str) -> str:
        return fleet.vehicle(vehicle).line if fleet.knows(vehicle) else ""

    return line


def _by_line(counted: Counted) -> dict[tuple[str, Edge], list[Key]]:
    """Vehicles with days, by line and edge."""
    found: dict[tuple[str, Edge], list[Key]] = {}
    for key, k in sorted(counted.place.items(), key=lambda item: item[0][0]):
        if counted.sums.days[k] > 0:
            found.setdefault((counted.line[k], key[1]), []).append(key)
    return dict(sorted(found.items(), key=lambda item: (item[0][0], edge_order(item[0][1]))))


@dataclass(frozen=True, eq=False)
class _Noise:
    """Ratio of days' scatter to their sigmas, and autocorrelation, by vehicle and edge as the audit charts them."""

    scale: dict[Key, Float[np.ndarray, " 6"]] = field(default_factory=dict)
    alike: dict[Key, Float[np.ndarray, " 6"]] = field(default_factory=dict)

    def scale_of(self, key: Key) -> Float[np.ndarray, " 6"]:
        """Of an edge, or of a pose by the edge of its two sensors."""
        return _as_charted(self.scale, key, 1.0)

    def alike_of(self, key: Key) -> Float[np.ndarray, " 6"]:
        """Of an edge, or of a pose by the edge of its two sensors."""
        return _as_charted(self.alike, key, 0.0)


def _as_charted(values: Mapping[Key, np.ndarray], key: Key, default: float) -> Float[np.ndarray, " 6"]:
    vehicle, edge = key
    if not isinstance(edge, RigPose):
        return values.get(key, np.full(DOFS, default))
    charted = values.get((vehicle, tie(*edge.sensors)))
    if charted is None:
        return np.full(DOFS, default)
    # The edge may have other axes than the reference: the largest of the three holds along any.
    return np.repeat(charted.reshape(2, 3).max(axis=1), 3)


def _of_audit(lake: Lake, method: str) -> tuple[dict[str, list[DriftFinding]], _Noise]:
    """The last audit's changes by vehicle, and noise of days."""
    table = read_last_columns(lake, DRIFT, method, _OF_DRIFT)
    if table is None:
        return {}, _Noise()
    alarm = pc.and_(pc.is_in(table["status"], pa.array(["RED", "YELLOW"])), pc.is_valid(table["start_day"]))
    changes: dict[str, list[DriftFinding]] = {}
    for row in table.filter(alarm).select(list(_OF_DRIFT)).to_pylist():
        finding = DriftFinding(day="", method=method, reason="", days_used=0, limit=0.0, **row)
        changes.setdefault(row["vehicle"], []).append(finding)
    noise = _Noise()
    noisy = table.filter(pc.is_valid(table["day_scale"]))
    names = ("vehicle", *_EDGE, "dof", "day_scale", "day_autocorrelation")
    edges: dict[tuple[str, str, str], Edge] = {}
    for vehicle, *of, dof, size, phi in zip(*(noisy[n].to_pylist() for n in names), strict=True):
        name = (of[0], of[1], of[2])
        edge = edges.get(name) or edges.setdefault(name, edge_named(*name))
        k = DOF_NAMES.index(dof)
        noise.scale.setdefault((vehicle, edge), np.ones(DOFS))[k] = size
        noise.alike.setdefault((vehicle, edge), np.zeros(DOFS))[k] = phi or 0.0
    return changes, noise


def _of_last_night(
    lake: Lake, method: str
) -> tuple[dict[tuple[str, Edge], Drawing], dict[tuple[str, Edge], dict[str, int]]]:
    """Drawings from which the sums of the last night count, and last days of other releases, by line and edge."""
    drawings: dict[tuple[str, Edge], Drawing] = {}
    others: dict[tuple[str, Edge], dict[str, int]] = {}
    for r in read_last(lake, FLEET_MODEL, FleetModelRow, method):
        of = r.line, line_edge(r)
        pairs = [text.split(" until ") for text in r.other_releases]
        others[of] = {
            release: dt.date.fromisoformat(day).toordinal()
            for release, day in pairs
            if release != release_of(CODE_VERSION)
        }
        drawing = pose_of(partial(getattr, r), "drawing_")
        if drawing is not None:
            drawings[of] = Drawing(drawing)
    return drawings, others


def _with_other_releases(row: FleetModelRow, others: Mapping[str, int]) -> FleetModelRow:
    texts = [f"{release} until {day_name(day)}" for release, day in sorted(others.items())]
    words = f"records of release {', '.join(texts)} do not count" if texts else ""
    reason = "; ".join(text for text in (row.reason, words) if text)
    return replace(row, other_releases=texts, reason=reason)


def _with_line_before(answer: LineAnswer, line: str | None) -> LineAnswer:
    if line is None:
        return answer
    words = f"its line was {line or 'none'} until now: all of its days count with {answer.line}"
    return replace(answer, reason="; ".join(text for text in (words, answer.reason) if text))


def _since(edge: Edge, events: Sequence[ServiceEvent], changes: Sequence[DriftFinding], last: str) -> str:
    """First day that may count, after a service event or a change; empty where all days may."""
    if isinstance(edge, RigPose):
        return since_of_pose(edge.child, edge, events, changes, last)[0]
    return since_of(edge, events, changes, last)[0]


def _is_remounted(edge: Edge, events: Sequence[ServiceEvent]) -> bool:
    names = {"all", *(sensor.name for sensor in edge.sensors)}
    return any(e.kind == "re-mount" and e.sensor in names for e in events)


def _has_changed(edge: Edge, changes: Sequence[DriftFinding]) -> bool:
    red = [c for c in changes if c.status == "RED"]
    if isinstance(edge, RigPose):
        return since_of_pose(edge.child, edge, (), red, "")[0] != ""
    of = (edge.kind, edge.parent.name, edge.child.name)
    return any((c.pair, c.parent_frame, c.child_frame) == of for c in red)


def _told(rows: Sequence[LineAnswer]) -> Told:
    counts = Counter(r.status for r in rows)
    differ = [r for r in rows if r.differs]
    named = ", ".join(f"{r.vehicle} ({r.pair} {r.distance_axis})" for r in differ[:5])
    more = f" and {len(differ) - 5} more" if len(differ) > 5 else ""
    if not rows:
        return Told({}, reason="no calibration record of this release counts", refused=True)
    return Told(dict(counts), reason=f"differ from their line: {named}{more}" if differ else "")
