"""What the fleet page says, from table calibrations and table drift: plain values for the template, no HTML."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.changes import change_between, change_covariance
from pipeline.report.day import clearest_alarm, status_sentence
from pipeline.report.figures import DriftPanel
from pipeline.report.words import PAIR_TITLES, motion_in_words, with_sigma
from pipeline.store.current import transform_of
from schemas.calibrations import DOF_NAMES, PAIRS, CalibrationRecord
from schemas.drift import DRIFT_STATUSES, DriftFinding, status_of

__all__ = [
    "DayCell",
    "FindingView",
    "VehicleRow",
    "drift_panels",
    "finding_views",
    "headline_for",
    "vehicle_rows",
]

_WORST = ("refused", "held", "accepted")


@dataclass(frozen=True)
class DayCell:
    """One vehicle-day of the table; `link` is relative to the fleet page, empty where there is no page."""

    day: str
    status: str
    text: str
    link: str


@dataclass(frozen=True)
class VehicleRow:
    """One vehicle of the table."""

    vehicle: str
    status: str
    sentence: str
    cells: list[DayCell]


@dataclass(frozen=True)
class FindingView:
    """One vehicle in which something changed."""

    vehicle: str
    status: str
    sensor: str
    since: str
    kind: str
    motion: str
    sure: str
    charts: list[str]


def vehicle_rows(
    records: Sequence[CalibrationRecord],
    findings: Sequence[DriftFinding],
    days: Sequence[str],
    links: Mapping[tuple[str, str], str],
) -> list[VehicleRow]:
    """The table vehicles x days, alarmed vehicles first."""
    found = _by_vehicle(findings)
    statuses: dict[tuple[str, str], list[str]] = {}
    for record in records:
        statuses.setdefault((record.vehicle, record.day), []).append(record.status)
    rows = []
    for vehicle in sorted({r.vehicle for r in records} | set(found)):
        status, sentence = status_sentence(found.get(vehicle, []))
        cells = [_cell(statuses.get((vehicle, d), []), d, links.get((vehicle, d), "")) for d in days]
        rows.append(VehicleRow(vehicle, status, sentence, cells))
    return sorted(rows, key=lambda r: (DRIFT_STATUSES.index(r.status), r.vehicle))


def finding_views(findings: Sequence[DriftFinding]) -> list[FindingView]:
    """What changed, vehicle by vehicle: RED before YELLOW."""
    views = []
    for vehicle, own in _by_vehicle(findings).items():
        clearest = clearest_alarm(own)
        if clearest is not None:
            views.append(_finding_view(vehicle, clearest, own))
    return sorted(views, key=lambda v: (DRIFT_STATUSES.index(v.status), v.vehicle))


def headline_for(findings: Sequence[DriftFinding], views: Sequence[FindingView]) -> tuple[str, str]:
    """(the most urgent status in the fleet; the page's first sentence)."""
    statuses = [status_of(own).status for own in _by_vehicle(findings).values()]
    vehicles = _count(len(statuses), "vehicle")
    if not statuses:
        return "UNKNOWN", "No audit yet: run boresight audit."
    worst = min(statuses, key=DRIFT_STATUSES.index)
    if worst == "GREEN":
        return worst, f"No sensor moved on {vehicles}."
    if worst == "UNKNOWN":
        where = f"on {statuses.count(worst)} of {vehicles}"
        return worst, f"No change seen, but {where} the days so far could hide one that matters."
    named = [f"{v.vehicle}: {v.sensor} since {v.since}" for v in views if v.status == worst][:3]
    more = "" if len(views) <= 3 else f" and {len(views) - 3} more"
    verb = "A sensor moved" if worst == "RED" else "Something may have moved"
    return worst, f"{verb} on {len(views)} of {vehicles}: {'; '.join(named)}{more}."


def drift_panels(
    vehicle: str, records: Sequence[CalibrationRecord], findings: Sequence[DriftFinding]
) -> list[DriftPanel]:
    """The vehicle's charts with the day estimates they rest on, each relative to its level before the change."""
    panels = []
    for pair in PAIRS:
        rows = [r for r in records if (r.vehicle, r.pair) == (vehicle, pair)]
        used = [r for r in rows if r.status != "refused" and r.covariance is not None]
        for k, dof in enumerate(DOF_NAMES):
            finding = next((f for f in findings if (f.vehicle, f.pair, f.dof) == (vehicle, pair, dof)), None)
            if finding is not None:
                panels.append(_panel(finding, rows, used, k))
    return panels


def _panel(
    finding: DriftFinding, rows: Sequence[CalibrationRecord], used: Sequence[CalibrationRecord], k: int
) -> DriftPanel:
    seen = [r for r in used if r.observable is None or r.observable[k]]
    start = None
    if finding.start_day and finding.start_day_earliest and finding.start_day_latest:
        start = (
            _ordinal(finding.start_day),
            _ordinal(finding.start_day_earliest),
            _ordinal(finding.start_day_latest),
        )
    day = [_ordinal(r.day) for r in seen]
    T = [t for t in map(transform_of, seen) if t is not None]
    value = np.array([change_between(T[0], t)[k] for t in T])
    sigma = np.array(
        [
            np.sqrt(change_covariance(t, r.covariance)[k, k])
            for t, r in zip(T, seen, strict=True)
            if r.covariance is not None
        ]
    )
    before = np.array([start is None or d < start[0] for d in day], dtype=bool)
    if before.any():
        value = value - np.average(value[before], weights=sigma[before] ** -2)
    missing = sorted({_ordinal(r.day) for r in rows} - set(day))
    held = [_ordinal(r.day) for r in seen if r.status == "held"]
    values, sigmas = value.tolist(), sigma.tolist()
    return DriftPanel(
        finding.pair, finding.dof, finding.status, day, values, sigmas, finding.limit, start, missing, held
    )  # fmt: skip


def _cell(statuses: Sequence[str], day: str, link: str) -> DayCell:
    if not statuses:
        return DayCell(day, "none", "-", link)
    accepted = statuses.count("accepted")
    if accepted == len(statuses):
        return DayCell(day, "accepted", "accepted", link)
    if accepted:
        return DayCell(day, "partly", f"{accepted} of {len(statuses)} accepted", link)
    worst = next(s for s in _WORST if s in statuses)
    return DayCell(day, worst, worst, link)


def _by_vehicle(findings: Sequence[DriftFinding]) -> dict[str, list[DriftFinding]]:
    found: dict[str, list[DriftFinding]] = {}
    for finding in findings:
        found.setdefault(finding.vehicle, []).append(finding)
    return found


def _finding_view(vehicle: str, clearest: DriftFinding, own: Sequence[DriftFinding]) -> FindingView:
    earliest, latest = clearest.start_day_earliest, clearest.start_day_latest
    motion = clearest.reason
    if clearest.moved_sensor is not None:
        motion = motion_in_words(
            clearest.moved_sensor, clearest.moved_motion or [], clearest.moved_motion_sigma or []
        )
    alarms = sorted((f for f in own if f.start_day), key=lambda f: -(f.statistic or 0.0))
    return FindingView(
        vehicle,
        clearest.status,
        clearest.moved_sensor or "not clear which",
        f"{clearest.start_day}" + ("" if earliest == latest else f" ({earliest} to {latest})"),
        clearest.kind or "",
        motion,
        _sure(clearest),
        [_chart_words(f) for f in alarms],
    )


def _sure(finding: DriftFinding) -> str:
    parts = []
    if finding.statistic is not None and finding.threshold is not None:
        parts.append(f"change {finding.statistic:.1f} sigma, alarm from {finding.threshold:.1f}")
    if finding.moved_probability is not None:
        share = 100 * finding.moved_probability
        parts.append(f"sensor {'> 99.9' if share > 99.9 else f'{share:.1f}'} %")
    return "; ".join(parts)


def _chart_words(finding: DriftFinding) -> str:
    if finding.magnitude is None or finding.magnitude_sigma is None:
        return f"{PAIR_TITLES[finding.pair]} {finding.dof}"
    size = with_sigma(finding.magnitude, finding.magnitude_sigma, finding.dof)
    return f"{PAIR_TITLES[finding.pair]} {finding.dof} {size}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _ordinal(day: str) -> int:
    return dt.date.fromisoformat(day).toordinal()
