"""Records for an audit: the window, and the first accepted days of vehicles without a stored reference.

One month is in memory at a time, as columns, and reading ends when no vehicle lacks days. References, and
first accepted days, are stored in table states: a night reads no more of the past.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

import numpy as np
import pyarrow.compute as pc

from pipeline.audit.days import Reference
from pipeline.audit.estimates import COLUMNS, Estimates, day_name, estimates_of, faults_of, joined
from pipeline.audit.references import first_accepted, read_kept, restart_of
from pipeline.core.config import FleetConfig
from pipeline.rig.graph import Edge, words_of
from pipeline.store.partitions import Lake, days_after, months_before
from pipeline.store.records import first_day, last_day, read_columns
from schemas.calibrations import CALIBRATIONS
from schemas.service_events import ServiceEvent

__all__ = ["History", "last_audited_day", "models_of"]

_MONTHS_BACK = 4  # that a window of few days reaches back
_YEARS_BACK = 20  # before which no lake began
_FIRST_DAYS = 14  # of a lake, read before the rest of its first month: a reference takes ten accepted ones


def last_audited_day(lake: Lake, tomorrow: str) -> str | None:
    """The last day with a record, without future days; None if there is none."""
    last = last_day(lake, CALIBRATIONS)
    if last is None or last <= tomorrow:
        return last
    found = read_columns(lake, CALIBRATIONS, (), first=None, last=tomorrow)
    return None if found is None else str(pc.max(found["day"]).as_py())


def models_of(fleet: FleetConfig, vehicles: Iterable[str]) -> list[str]:
    """Model of each vehicle, if fleet.toml has the vehicle."""
    return [fleet.vehicle(vehicle).model_or_rig if fleet.knows(vehicle) else "" for vehicle in vehicles]


@dataclass
class History:
    """Reads the current records of a method, and lists unusable ones in `left_out`.

    `latest` is the last day that a drive can have.
    """

    lake: Lake
    method: str
    latest: str
    left_out: dict[str, None] = field(default_factory=dict)

    def window(
        self,
        window: tuple[str, str],
        events: Mapping[str, Sequence[ServiceEvent]],
        enough: tuple[int, int],
        asked: Collection[str],
    ) -> tuple[Estimates, dict[str, dict[Edge, Reference]]]:
        """Records for the charts, and references that need no records, by vehicle and edge.

        Args:
            events: service events by vehicle; earlier days are not needed.
            enough: smallest number of days of a chart, and number of accepted days of a reference.
            asked: vehicles to include even if they did not drive in the window.
        """
        (first, last), (fewest, count) = window, enough
        parts = [self.read(first, last)]
        driven = Counter(dict.fromkeys(asked, 0)) + _days_driven(parts[0])
        begin = dict.fromkeys({*asked, *parts[0].vehicles}, first)
        for month, end in months_before(first, _MONTHS_BACK):
            sparse = {v for v in begin if driven[v] < fewest}
            if not sparse:
                break
            parts.append(self.read(month, end, sparse))
            driven += _days_driven(parts[-1])
            begin |= dict.fromkeys(sparse, month)
        kept = read_kept(self.lake, self.method, window, events, count)
        known = joined(parts)
        usable = known.at(np.flatnonzero(known.usable))
        # A chart of few days shows the days of the reference too, instead of their mean.
        often = {key for key, days in Counter(_edges(usable)).items() if days > fewest}
        lacking = {key: first_accepted(kept.get(key)) for key in set(_edges(known))}
        made: dict[str, dict[Edge, Reference]] = {}
        for vehicle, edge in often & kept.keys():
            own = kept[vehicle, edge].reference
            if own is not None and day_name(own.days[-1]) < begin[vehicle]:
                made.setdefault(vehicle, {})[edge] = own
                del lacking[vehicle, edge]
        return joined([known, *self.references(begin, window, events, count, lacking)]), made

    def references(
        self, begin: Mapping[str, str], window: tuple[str, str], events: Mapping[str, Sequence[ServiceEvent]],
        count: int, asked: Mapping[tuple[str, Edge], str | None],
    ) -> Iterator[Estimates]:  # fmt: skip
        """Records of the first accepted days of edges since their last service event.

        `begin` is the day from which each vehicle's records are known already; `asked` has the edges, with
        the first day from which to search (None = no accepted day is known).
        """
        until, last = window
        restart = {key: restart_of(events.get(key[0], ()), key[1], last) for key in asked}
        since = {
            key: max(start, "" if (event := restart[key]) is None else days_after(event.day, 1))
            for key, start in asked.items()
            if start is not None
        }
        lacking = {key for key, start in since.items() if start < until}
        accepted: Counter[tuple[str, Edge]] = Counter()
        for month, end in _months_until(self.lake, until):
            vehicles = {key[0] for key in lacking if since[key] <= end}
            if not vehicles:
                continue
            part = self.read(month, end, vehicles)
            rows = []
            of_row = zip(_edges(part), part.day.tolist(), part.accepted.tolist(), strict=True)
            for row, (key, ordinal, is_accepted) in enumerate(of_row):
                if key not in lacking or day_name(ordinal) < since[key]:
                    continue
                if accepted[key] < count and day_name(ordinal) < begin[key[0]]:
                    rows.append(row)
                accepted[key] += is_accepted
            yield part.at(np.array(rows, np.int64))
            lacking = {key for key in lacking if accepted[key] < count}

    def read(self, first: str | None, last: str | None, among: AbstractSet[str] | None = None) -> Estimates:
        """Sound records of a span of days, of all vehicles or of some."""
        if among is not None:  # few, who may have driven on few of its days: a few columns show which
            known = read_columns(self.lake, CALIBRATIONS, (), first=first, last=last, vehicle=among)
            if known is None:
                return estimates_of(None)
            days = pc.min_max(known["day"]).as_py()
            first, last = days["min"], days["max"]
        found = read_columns(self.lake, CALIBRATIONS, COLUMNS, first=first, last=last, vehicle=among)
        if found is not None:
            found = found.filter(pc.equal(found["method"], self.method))
        records = estimates_of(found)
        faults = faults_of(records, self.latest)
        for row, why in faults.items():
            owner, day = records.vehicles[records.owner[row]], day_name(int(records.day[row]))
            edge = int(records.edge[row])
            what = words_of(records.edges[edge]) if edge >= 0 else "record"
            self.left_out[f"{owner} {day} {what} {why}"] = None
        kept = np.delete(np.arange(len(records.day)), list(faults))
        return joined([records.at(kept)]) if faults else records


def _edges(records: Estimates) -> list[tuple[str, Edge]]:
    """Vehicle and edge of each record."""
    names, edges = records.vehicles, records.edges
    return [(names[v], edges[e]) for v, e in zip(records.owner.tolist(), records.edge.tolist(), strict=True)]


def _days_driven(records: Estimates) -> Counter[str]:
    """Number of days with a record, by vehicle."""
    owner = np.unique(np.stack([records.owner, records.day]), axis=1)[0]
    return Counter(
        {records.vehicles[v]: int(n) for v, n in zip(*np.unique(owner, return_counts=True), strict=True)}
    )


def _months_until(lake: Lake, day: str) -> Iterator[tuple[str, str]]:
    """Months before a day, the earliest first, in which most vehicles' references are."""
    months = list(months_before(day, 12 * _YEARS_BACK))
    begun = first_day(lake, CALIBRATIONS) or day
    for month, end in reversed([m for m in months if m[1] >= begun]):
        until = min(end, days_after(begun, _FIRST_DAYS - 1))
        if month <= begun < end and until < end:
            yield begun, until
            month = days_after(until, 1)  # noqa: PLW2901
        yield month, end
