"""Content of the fleet page from tables calibrations and drift: plain values for the template, no HTML."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress, product
from typing import Any

import numpy as np
from jaxtyping import Int

from pipeline.report.day import clearest_alarm, status_sentence
from pipeline.report.page import page_stem
from pipeline.report.verdicts import FleetVerdicts
from pipeline.report.window import FleetWindow
from pipeline.report.words import ANSWERS, dof_title, kind_of_sensor, motion_in_words, with_sigma
from pipeline.store.partitions import Lake
from schemas.calibrations import STATUSES
from schemas.drift import DRIFT_STATUSES, DriftFinding, status_of
from schemas.words import DAY_WORDS, day_word

__all__ = [
    "DAY_LETTERS",
    "FindingView",
    "VehicleRow",
    "finding_views",
    "fleet_rows",
    "headline_for",
    "index_row",
]

# How a vehicle-day is shown: letter of the index, sign and words. Capitals in the index: the day has a page.
_SIGNS = {"done": "d✓", "partly": "p◐", "held": "h○", "refused": "r✕"}
DAY_LETTERS = {sign[0]: (word, sign[1], f"{word} ({DAY_WORDS[word]})") for word, sign in _SIGNS.items()} | {
    ".": ("none", "·", "no record")
}
_COLUMNS = 28  # days that the table has: four weeks; a vehicle's older ones are with its charts


@dataclass(frozen=True)
class VehicleRow:
    """One vehicle of the table.

    Args:
        sensor: sensor that moved; empty if none did or it is unknown.
        since: first day after the change; empty if there was none.
        days: a letter of DAY_LETTERS per day of the table, capital if the day has a page.
        last_day: last day with a record; empty if there is none.
        older: earlier days than those of the table, with their letters.
    """

    vehicle: str
    status: str
    sentence: str
    sensor: str
    since: str
    days: str
    last_day: str
    older: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True)
class FindingView:
    """One vehicle in which something changed, in words."""

    vehicle: str
    status: str
    sensor: str
    since: str
    kind: str
    motion: str
    sure: str
    charts: list[str]


def fleet_rows(
    window: FleetWindow, verdicts: FleetVerdicts, pages: Collection[tuple[str, str]], lake: Lake
) -> tuple[list[str], list[VehicleRow]]:
    """The table's days, and its vehicles: the most urgent first.

    RED before YELLOW, UNKNOWN and GREEN; the latest changes first. `lake` is named in the commands of the
    next steps.
    """
    ordinals, letters = _letters(window)
    names = [dt.date.fromordinal(day).isoformat() for day in ordinals.tolist()]
    place = {vehicle: v for v, vehicle in enumerate(window.vehicles)}
    first = max(0, len(names) - _COLUMNS)
    rows = []
    for vehicle in sorted({*window.vehicles, *verdicts.vehicles}):
        own = verdicts.findings.get(vehicle, [])
        status, sentence = status_sentence(own, lake, verdicts.corrections.get(vehicle, ""))
        stored = status_of(own)
        shown = letters[place[vehicle]] if vehicle in place else "." * len(names)
        marked = [
            letter.upper() if letter != "." and (vehicle, day) in pages else letter
            for day, letter in zip(names, shown, strict=True)
        ]
        known = [(day, letter) for day, letter in zip(names, marked, strict=True) if letter != "."]
        rows.append(
            VehicleRow(
                vehicle,
                status,
                sentence,
                stored.sensor or "",
                stored.since or "",
                "".join(marked[first:]),
                known[-1][0] if known else "",
                [(day, letter) for day, letter in known if first and day < names[first]],
            )
        )
    return names[first:], sorted(rows, key=_attention)


def index_row(row: VehicleRow, sentences: dict[str, int], finding: FindingView | None) -> list[Any]:
    """A vehicle as `templates/fleet.js` reads it; sentences are stored once and referenced by index."""
    stem = page_stem(row.vehicle)
    said = sentences.setdefault(row.sentence, len(sentences))
    change = [finding.kind, finding.motion, finding.sure, finding.charts] if finding is not None else 0
    return [
        row.vehicle, DRIFT_STATUSES.index(row.status), row.sensor, row.since, said, row.days, row.last_day,
        stem if stem != row.vehicle else 0, row.older or 0, change,
    ]  # fmt: skip


def finding_views(findings: Mapping[str, Sequence[DriftFinding]]) -> list[FindingView]:
    """Changes by vehicle: RED before YELLOW, the latest change first."""
    alarms = ((vehicle, own, clearest_alarm(own)) for vehicle, own in findings.items())
    views = [_finding_view(vehicle, alarm, own) for vehicle, own, alarm in alarms if alarm is not None]
    return sorted(views, key=_attention)


def headline_for(verdicts: FleetVerdicts, views: Sequence[FindingView]) -> tuple[str, str]:
    """(the most urgent status in the fleet; the page's first sentence)."""
    statuses = [status_of(own).status for own in verdicts.findings.values()]
    vehicles = f"{len(statuses)} vehicle{'s' * (len(statuses) != 1)}"
    if not statuses:
        return "UNKNOWN", ANSWERS["no audit"]
    worst = min(statuses, key=DRIFT_STATUSES.index)
    if worst != "GREEN":
        vehicles = f"{statuses.count(worst)} of {vehicles}"
    of_these = [v for v in views if v.status == worst]
    named = "; ".join(f"{v.vehicle}: {v.sensor} since {v.since}" for v in of_these[:3])
    named += "" if len(of_these) <= 3 else f" and {len(of_these) - 3} more"
    said = ANSWERS[worst].format(vehicles=vehicles, named=named)
    if worst == "RED" and "YELLOW" in statuses:
        said += ANSWERS["YELLOW too"].format(more=statuses.count("YELLOW"))
    return worst, said


def _attention(row: VehicleRow | FindingView) -> tuple[int, int, str]:
    since = row.since[: len("YYYY-MM-DD")]
    newest = -dt.date.fromisoformat(since).toordinal() if since else 0
    return DRIFT_STATUSES.index(row.status), newest, row.vehicle


def _letters(window: FleetWindow) -> tuple[Int[np.ndarray, " D"], list[str]]:
    """Days with a record of any vehicle, and each vehicle's letters of DAY_LETTERS on them."""
    days, column = np.unique(window.day, return_inverse=True)
    cell = window.owner * len(days) + column
    size = len(window.vehicles) * len(days)
    seen = np.zeros((len(STATUSES), size), bool)
    seen[window.status, cell] = True
    letters = np.full(size, ".")
    for statuses in product((False, True), repeat=len(STATUSES)):
        if any(statuses):
            alike = np.all(np.array(statuses) == seen.T, axis=1)
            letters[alike] = _SIGNS[day_word(compress(STATUSES, statuses))][0]
    return days, ["".join(row) for row in letters.reshape(len(window.vehicles), len(days))]


def _finding_view(vehicle: str, clearest: DriftFinding, own: Sequence[DriftFinding]) -> FindingView:
    earliest, latest = clearest.start_day_earliest, clearest.start_day_latest
    motion = clearest.reason
    if clearest.moved_sensor is not None:
        kind = kind_of_sensor(clearest.moved_sensor, own)
        motion = motion_in_words(kind, clearest.moved_motion or [], clearest.moved_motion_sigma or [])
    alarms = sorted((f for f in own if f.start_day), key=lambda f: -(f.statistic or 0.0))
    return FindingView(
        vehicle,
        clearest.status,
        clearest.moved_sensor or "undecided",
        f"{clearest.start_day}" + ("" if earliest == latest else f" ({earliest} to {latest})"),
        clearest.kind or "",
        motion,
        _sure(clearest),
        [_chart_words(f) for f in alarms],
    )


def _sure(finding: DriftFinding) -> str:
    parts = [f"change of {finding.statistic:.1f} sigma (alarm above {finding.threshold:.1f})"]
    if finding.moved_probability is not None:
        share = 100 * finding.moved_probability
        parts.append(f"this sensor with {'> 99.9' if share > 99.9 else f'{share:.1f}'} %")
    return "; ".join(parts)


def _chart_words(finding: DriftFinding) -> str:
    chart = f"{finding.parent_frame}-{finding.child_frame} {dof_title(finding.pair, finding.dof)}"
    if finding.magnitude is None or finding.magnitude_sigma is None:
        return chart
    return f"{chart} {with_sigma(finding.magnitude, finding.magnitude_sigma, finding.dof)}"
