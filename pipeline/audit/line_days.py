"""What each vehicle's days show, summed night by night from the records that are new."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow.compute as pc
from jaxtyping import Float, Int

from pipeline.audit.days import DOFS
from pipeline.audit.estimates import day_name
from pipeline.audit.line_records import Asked, LineRecords, read_line_records, release_of
from pipeline.fleet_model.sums import DaySums, day_evidence, packed, unpacked
from pipeline.geometry.changes import change_between, changed
from pipeline.rig.edges import line_edges
from pipeline.rig.graph import Edge
from pipeline.store.columns import matrices, ordinals
from pipeline.store.partitions import Lake, days_after
from pipeline.store.records import first_day, read_last_columns
from schemas.calibrations import CALIBRATIONS
from schemas.fleet_model import LINE_ANSWERS
from schemas.versions import CODE_VERSION

__all__ = ["Counted", "DaysOfLines", "Drawing", "Key"]

Key = tuple[str, Edge]  # vehicle, and edge or pose

_OF_ANSWERS = (
    *("vehicle", "day", "line", "pair", "kinds", "parent_frame", "child_frame", "code_version"),
    *("sums", "days", "recent_days", "first_day", "last_day", "away", "restart", "recent_keys", "read_until"),
)
_IN_ORDER = [(name, "ascending") for name in ("vehicle", "pair", "parent_frame", "child_frame")]
_CLOCKS_DIFFER = dt.timedelta(hours=24)  # of machines that commit records, as for all record tables


@dataclass(frozen=True, eq=False)
class Drawing:
    """Pose T_parent_child from which changes of a line's edge count."""

    T: Float[np.ndarray, "4 4"]


@dataclass(eq=False)
class Counted:
    """Sums of days by vehicle and edge, and what the next night must know to go on from them.

    Args:
        place: row of a vehicle and edge in `sums` and the lists.
        line: model line of the vehicle when its days were counted.
        restart: first day that might count; empty = any.
        recent: by day, stamp and work key of counted records that the next night may read again.
        read_until: stamp of the last record of any vehicle that was read.
        day: last day of the window that was read; empty = none was.
        other_releases: of records that do not count: their last days, by line and edge.
        changed_line: vehicles whose line was another one last night, and that line.
    """

    place: dict[Key, int] = field(default_factory=dict)
    sums: DaySums = field(default_factory=lambda: DaySums.empty(0))
    line: list[str] = field(default_factory=list)
    restart: list[str] = field(default_factory=list)
    recent: list[dict[int, tuple[str, str]]] = field(default_factory=list)
    read_until: str = ""
    day: str = ""
    other_releases: dict[tuple[str, Edge], dict[str, int]] = field(default_factory=dict)
    changed_line: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, lake: Lake, method: str) -> Counted:
        """What the last night of this release counted; empty on its first."""
        table = read_last_columns(lake, LINE_ANSWERS, method, _OF_ANSWERS)
        rows = None if table is None else table.filter(pc.is_valid(table["sums"])).sort_by(_IN_ORDER)
        if (
            rows is None
            or not len(rows)
            or release_of(rows["code_version"][0].as_py()) != release_of(CODE_VERSION)
        ):
            return cls()
        vehicles, edges = rows["vehicle"].to_pylist(), line_edges(rows)
        place = {key: k for k, key in enumerate(zip(vehicles, edges, strict=True))}
        when = [ordinals(rows["first_day"]), ordinals(rows["last_day"]), rows["away"].to_numpy()]
        days = np.stack([rows[name].to_numpy() for name in ("days", "recent_days")], axis=1)
        return cls(
            place,
            unpacked(matrices(rows["sums"], (5, 27)), days, np.stack(when, axis=1)),
            rows["line"].to_pylist(),
            rows["restart"].to_pylist(),
            [_recent_of(texts) for texts in rows["recent_keys"].to_pylist()],
            pc.max(rows["read_until"]).as_py(),
            rows["day"][0].as_py(),
        )

    def columns(self, rows: Int[np.ndarray, " R"]) -> list[dict[str, Any]]:
        """Columns of rows of `line_answers` that the next night goes on from."""
        sums = self.sums.at(rows)
        whole = packed(sums)
        return [
            {
                "line": self.line[k],
                "sums": whole[r],
                "days": float(sums.days[r]),
                "recent_days": float(sums.recent_days[r]),
                "first_day": day_name(int(sums.first[r])),
                "last_day": day_name(int(sums.last[r])),
                "away": int(sums.away[r]),
                "restart": self.restart[k],
                "recent_keys": [f"{day_name(d)} {stamp} {key}" for d, (stamp, key) in self.recent[k].items()],
                "read_until": self.read_until,
            }
            for r, k in enumerate(rows.tolist())
        ]

    def rows_for(self, keys: Collection[tuple[Key, str, str]]) -> None:
        """Add empty sums for new vehicles and edges, given with line and first day that may count."""
        new = [key for key in keys if key[0] not in self.place]
        for key, line, restart in new:
            self.place[key] = len(self.line)
            self.line.append(line)
            self.restart.append(restart)
            self.recent.append({})
        grown = DaySums.empty(len(self.line))
        grown.put(np.arange(len(self.line) - len(new)), self.sums)
        self.sums = grown

    def forget(self, keys: Collection[Key]) -> None:
        """Remove the days of some vehicles and edges, which are counted anew."""
        kept = [key for key in self.place if key not in keys]
        rows = np.array([self.place[key] for key in kept], np.int64)
        self.sums = self.sums.at(rows)
        for name in ("line", "restart", "recent"):
            values = getattr(self, name)
            setattr(self, name, [values[k] for k in rows])
        self.place = {key: k for k, key in enumerate(kept)}


@dataclass(frozen=True, eq=False)
class DaysOfLines:
    """Counts the days of a fleet.

    Args:
        window: first and last day that may count.
        gone: vehicles that were last seen before this day are left out.
        line_of: model line of a vehicle; empty: none of its days counts.
        restart: first day that may count after a service event or a change; empty where there was none.
        scale: ratio of days' scatter to their sigmas, by axis.
        drawings: by line and edge; those of new lines are added.
    """

    lake: Lake
    method: str
    window: tuple[str, str]
    gone: str
    line_of: Callable[[str], str]
    restart: Callable[[Key], str]
    scale: Callable[[Key], Float[np.ndarray, " 6"]]
    drawings: dict[tuple[str, Edge], Drawing]

    def count(self, counted: Counted) -> Counted:
        """Add the days that became current since the last night.

        All days of a vehicle are counted anew after a change or a service event, where a record of a day that is
        counted already was replaced, and where the vehicle was not counted the last night.
        """
        first, last = self.window
        first = max(first, first_day(self.lake, CALIBRATIONS) or last)
        since, day, until = _before(counted.read_until), counted.day, counted.read_until
        gone = _ordinal(self.gone)
        counted.forget({key for key, k in counted.place.items() if counted.sums.last[k] < gone})
        anew = {key for key, k in counted.place.items() if self._is_stale(counted, key, k)}
        before = {key[0]: counted.line[counted.place[key]] for key in anew}
        counted.changed_line = {v: line for v, line in before.items() if self.line_of(v) != line}
        known = frozenset(counted.place)
        # Days after the last window's may have been recorded before it was read, as after an audit of an earlier one.
        spans: list[tuple[str, str, str | None]] = [(first, min(day, last), since)] if since else []
        spans.append((max(first, days_after(day, 1)) if day else first, last, None))
        for begin, end, asserted_after in spans:
            for new in self._read(begin, end, asserted_after=asserted_after):
                until = max([until, *new.asserted])
                self._note_other_releases(new, counted)
                anew |= _replaced(new, counted)
                if day:
                    anew |= {key for key, ok in zip(new.keys(), new.usable, strict=True) if ok} - known
                self._add(new, counted, leave=anew)
        counted.forget(anew)
        vehicles = {vehicle for vehicle, _ in anew}
        for part in self._read(first, last, among=vehicles) if vehicles else ():
            self._add(part, counted, among=anew)
        # As the next night reads them, so that it has the same answers, to the last bit, if there is nothing new.
        sums = counted.sums
        days, when = (sums.days, sums.recent_days), (sums.first, sums.last, sums.away)
        counted.sums = unpacked(packed(sums), np.stack(days, axis=1), np.stack(when, axis=1))
        counted.read_until = until
        kept = _before(until) or ""
        counted.recent = [{d: of for d, of in own.items() if of[0] >= kept} for own in counted.recent]
        return counted

    def _note_other_releases(self, read: LineRecords, counted: Counted) -> None:
        for (vehicle, edge), days in read.other_releases.items():
            line = self.line_of(vehicle)
            of = counted.other_releases.setdefault((line, edge), {}) if line else {}
            of.update({release: max(day, of.get(release, 0)) for release, day in days.items()})

    def _is_stale(self, counted: Counted, key: Key, k: int) -> bool:
        line = self.line_of(key[0])
        if (line, key[1]) not in self.drawings or line != counted.line[k]:
            return True
        return self.restart(key) != counted.restart[k]

    def _read(
        self,
        first: str,
        last: str,
        *,
        asserted_after: str | None = None,
        among: Collection[str] | None = None,
    ) -> Iterator[LineRecords]:
        vehicles = None if among is None else frozenset(among)
        asked = Asked(self.method, self.window[1], vehicles, asserted_after)
        yield from read_line_records(self.lake, first, last, asked)

    def _add(
        self,
        read: LineRecords,
        counted: Counted,
        *,
        leave: Collection[Key] = (),
        among: Collection[Key] | None = None,
    ) -> None:
        """Count the days of records, in order, of all vehicles and edges but some, or of some."""
        self._draw(read)
        keys, records = read.keys(), read.records
        lines = [self.line_of(vehicle) for vehicle, _ in keys]
        begin = [_ordinal(self.restart(key)) for key in keys]
        counts = read.usable & (records.day >= np.array(begin, np.int64))
        counts &= np.array([line != "" for line in lines], bool)
        counts &= np.array([(key not in leave) and (among is None or key in among) for key in keys], bool)
        rows = np.flatnonzero(counts)
        counted.rows_for({(keys[r], lines[r], self.restart(keys[r])) for r in rows})
        place = np.array([counted.place.get(key, -1) for key in keys], np.int64)
        scale = np.array([self.scale(key) for key in keys]).reshape(-1, DOFS)
        work = records.work_key.to_pylist()
        for day in np.unique(records.day[rows]):
            of_day = rows[(records.day[rows] == day) & (counted.sums.last[place[rows]] < day)]
            of_line: dict[tuple[str, Edge], list[int]] = {}
            for r in of_day.tolist():
                of_line.setdefault((lines[r], keys[r][1]), []).append(r)
                counted.recent[place[r]][int(day)] = read.asserted[r], work[r]
            for (line, edge), which in of_line.items():
                own = np.array(which, np.int64)
                at = records.at(own)
                evidence = day_evidence(
                    self.drawings[line, edge].T,
                    (at.transforms(), at.covariance, at.common),
                    (read.prior[own], read.prior_covariance[own]),
                )
                sums = counted.sums.at(place[own]).with_day(evidence, int(day), scale[own])
                counted.sums.put(place[own], sums)

    def _draw(self, read: LineRecords) -> None:
        """Drawings of new lines and edges: the median prior of the first vehicles."""
        keys = read.keys()
        of_line: dict[tuple[str, Edge], list[int]] = {}
        for r in np.flatnonzero(read.usable).tolist():
            line = self.line_of(keys[r][0])
            if line and (line, keys[r][1]) not in self.drawings:
                of_line.setdefault((line, keys[r][1]), []).append(r)
        for of, rows in of_line.items():
            prior = read.prior[rows]
            middle = np.median(change_between(prior[0], prior), axis=0)
            self.drawings[of] = Drawing(changed(prior[0], middle))


def _replaced(read: LineRecords, counted: Counted) -> set[Key]:
    """Vehicles and edges with a new record of a day that is counted already, or was passed over."""
    found = set()
    rows = zip(read.keys(), read.records.day.tolist(), read.records.work_key.to_pylist(), strict=True)
    for key, day, work in rows:
        k = counted.place.get(key)
        if k is None or day > int(counted.sums.last[k]):
            continue
        if counted.recent[k].get(day, ("", ""))[1] != work:
            found.add(key)
    return found


def _recent_of(texts: Sequence[str]) -> dict[int, tuple[str, str]]:
    parts = [text.split(" ") for text in texts]
    return {_ordinal(day): (stamp, key) for day, stamp, key in parts}


def _ordinal(day: str | None) -> int:
    return dt.date.fromisoformat(day).toordinal() if day else 0


def _before(stamp: str) -> str | None:
    if not stamp:
        return None
    moment = dt.datetime.fromisoformat(stamp) - _CLOCKS_DIFFER
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")
