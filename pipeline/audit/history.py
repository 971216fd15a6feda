"""What an audit reads of a lake: the window, and of each vehicle the first accepted days, month by month and no more.

A month is held at a time, and reading ends as soon as no vehicle lacks days: in a lake whose vehicles began together
that is its first month, however old it is. A vehicle that has not had enough accepted days yet costs a look at all
months.
"""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet

from pipeline.audit.service import restart_of
from pipeline.store.current import current_records
from pipeline.store.partitions import Lake
from pipeline.store.records import first_day, last_day, read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.service_events import ServiceEvent

__all__ = ["last_audited_day", "read_history"]

# What charts need of a record besides what identifies it.
_COLUMNS = (
    *("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"),
    "covariance", "common_covariance", "observable", "diagnostics",
)  # fmt: skip
_MONTHS_BACK = 4  # that a window of few days reaches back
_YEARS_BACK = 20  # before which no lake began
_FIRST_DAYS = 14  # of a lake, read before the rest of its first month: a reference takes ten accepted ones


def last_audited_day(lake: Lake, tomorrow: str) -> str | None:
    """The last day that has a record and has come; None where there is none."""
    last = last_day(lake, CALIBRATIONS)
    if last is None or last <= tomorrow:
        return last
    days = [r.day for r in read_records(lake, CALIBRATIONS, CalibrationRecord, last=tomorrow, columns=())]
    return max(days, default=None)


def read_history(
    lake: Lake,
    window: tuple[str, str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    enough: tuple[int, int],
    sound: Callable[[CalibrationRecord], bool],
    asked: Collection[str] = (),
) -> list[CalibrationRecord]:
    """Current records of a method that charts need, in order of vehicle and day.

    Args:
        lake: where they are.
        window: first and last day, and the method.
        events: by vehicle; what lies before them is not asked for.
        enough: days that a chart needs at least, and accepted days that a reference takes.
        sound: False for a record that nothing can be made of.
        asked: vehicles that are wanted though they may not have driven in the window.
    """
    first, last, method = window
    fewest, reference_days = enough
    found = [r for r in _read(lake, first, last, method) if sound(r)]
    driven = Counter(v for v, _ in {(r.vehicle, r.day) for r in found})
    sparse = {v for v in {*driven, *asked} if driven[v] < fewest}
    for month, end in _months_before(first, _MONTHS_BACK):
        if not sparse:
            break
        more = [r for r in _read(lake, month, end, method, sparse) if sound(r)]
        driven.update(v for v, _ in {(r.vehicle, r.day) for r in more})
        found += more
        sparse = {v for v in sparse if driven[v] < fewest}
    found += _references(lake, window, events, reference_days, sound, found)
    unique = {(r.vehicle, r.day, r.trio, r.pair): r for r in found}
    return [unique[key] for key in sorted(unique)]


def _references(
    lake: Lake,
    window: tuple[str, str, str],
    events: Mapping[str, Sequence[ServiceEvent]],
    count: int,
    sound: Callable[[CalibrationRecord], bool],
    known: Sequence[CalibrationRecord],
) -> list[CalibrationRecord]:
    """Records of the first accepted days of each pair since it was last serviced, as far as the window lacks them."""
    until, last, method = window
    accepted: Counter[tuple[str, str]] = Counter()
    pairs = {(r.vehicle, r.pair) for r in known}
    restart = {key: restart_of(events.get(key[0], ()), key[1], last) for key in pairs}
    lacking = {key for key in pairs if (event := restart[key]) is None or event.day < until}
    found = []
    for month, end in _months_until(lake, until):
        if not lacking:
            break
        for record in _read(lake, month, end, method, {vehicle for vehicle, _ in lacking}):
            key = (record.vehicle, record.pair)
            event = restart.get(key)
            if key not in lacking or (event is not None and record.day <= event.day) or not sound(record):
                continue
            if accepted[key] < count:
                found.append(record)
            accepted[key] += record.status == "accepted"
        lacking = {key for key in lacking if accepted[key] < count}
    return found


def _read(
    lake: Lake, first: str, last: str, method: str, among: AbstractSet[str] | None = None
) -> list[CalibrationRecord]:
    window = {"first": first, "last": last}
    rows = read_records(lake, CALIBRATIONS, CalibrationRecord, **window, columns=_COLUMNS, vehicle=among)
    return [r for r in current_records(rows) if r.method == method]


def _months_before(day: str, count: int) -> Iterator[tuple[str, str]]:
    """First and last day of what lies before a day, by month, the latest first."""
    end = dt.date.fromisoformat(day) - dt.timedelta(days=1)
    for _ in range(count):
        yield end.replace(day=1).isoformat(), end.isoformat()
        end = end.replace(day=1) - dt.timedelta(days=1)


def _months_until(lake: Lake, day: str) -> Iterator[tuple[str, str]]:
    """The same, the earliest first, from the lake's first days on: in them lie most vehicles' references."""
    months = list(_months_before(day, 12 * _YEARS_BACK))
    begun = first_day(lake, CALIBRATIONS) or day
    for month, end in reversed([m for m in months if m[1] >= begun]):
        until = min(end, (dt.date.fromisoformat(begun) + dt.timedelta(days=_FIRST_DAYS - 1)).isoformat())
        if month <= begun < end and until < end:
            yield begun, until
            month = (dt.date.fromisoformat(until) + dt.timedelta(days=1)).isoformat()  # noqa: PLW2901
        yield month, end
