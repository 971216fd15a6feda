"""The page of a whole fleet, and files next to it with the charts, which are loaded on demand."""

from __future__ import annotations

import datetime as dt
import json
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any
from urllib.parse import quote

import numpy as np

from pipeline.report.charts import charted_edges, fleet_charts
from pipeline.report.fleet import DAY_LETTERS, VehicleRow, finding_views, fleet_rows, headline_for, index_row
from pipeline.report.page import page_stem, render, write_page
from pipeline.report.reading import fleet_records
from pipeline.report.truth import truth_rows, truth_summary
from pipeline.report.upkeep import Album
from pipeline.report.verdicts import FleetVerdicts
from pipeline.report.window import FleetWindow
from pipeline.report.words import dof_title
from pipeline.rig.graph import Edge
from pipeline.store.corrections import correction_steps
from pipeline.store.current import current_events
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import DOF_NAMES
from schemas.drift import DRIFT_STATUSES
from schemas.service_events import SERVICE_EVENTS, ServiceEvent

__all__ = ["render_fleet_page"]

_FINDINGS = 12  # named first; the table has them all
_ROWS = 50  # that are on the page without a script; the script shows all of them
_CHARTS = 24  # vehicles that the page shows charts of unasked; so many have their numbers in the page itself
_VEHICLES_A_FILE = 40  # whose charts a file beside the page holds: some 250 kB
_EVENTS = 20  # latest ones in the list; charts have all of the window
_WORK_KEYS = 8  # that the page names; the others it counts

Truth = Mapping[tuple[str, str], Mapping[str, np.ndarray]]


def render_fleet_page(
    album: Album,
    window: FleetWindow,
    verdicts: FleetVerdicts,
    pages: Collection[tuple[str, str]],
    truth: Truth | None = None,
) -> PurePath:
    """Write the page, and the files of its charts unless the fleet is small.

    Args:
        album: location and content of the page.
        truth: true extrinsics by (vehicle, day) and pair, for a simulated fleet.
    """
    days, rows = fleet_rows(window, verdicts, pages, album.lake)
    views = finding_views(verdicts.findings)
    edges = charted_edges(window, verdicts)
    records = fleet_records(album.lake, album.method, album.fleet.audit.window_days) if truth else []
    known = truth_rows(records, truth or {})
    ends = [window.day.min(), window.day.max()] if len(window.day) else []
    dates = [dt.date.fromordinal(int(day)).isoformat() for day in ends]
    events = _events_since(album.lake, min(dates, default=None))
    charts = fleet_charts(window, verdicts, events)
    counts = {s: sum(r.status == s for r in rows) for s in DRIFT_STATUSES}
    html = render(
        "fleet.html",
        fleet=album.fleet.fleet.name,
        method=album.method,
        span=" to ".join(dates) or "no calibration record yet",
        headline=headline_for(verdicts, views),
        false_alarms=f"{album.fleet.audit.false_alarms_per_1000_vehicle_days:g}",
        corrections=correction_steps(verdicts.corrections),
        findings=views[:_FINDINGS],
        findings_left=max(0, len(views) - _FINDINGS),
        counts=counts,
        rows=rows[:_ROWS],
        total=len(rows),
        days=days,
        events=events[:_EVENTS],
        words=DAY_LETTERS,
        link=lambda vehicle, day: f"{quote(album.folder.name)}/{day}/{quote(page_stem(vehicle))}.html",
        shown=rows[:_CHARTS],
        index=json.dumps(_index(album, days, rows, {v.vehicle: v for v in views}, (edges, charts))),
        dofs=[f"{how} {axis} [{unit}]" for how, unit in (("about", "deg"), ("along", "m")) for axis in "xyz"],
        truth=known,
        truth_summary=truth_summary(known),
        provenance=_provenance(window, verdicts),
    )  # fmt: skip
    return write_page(album.page, html, album.files)


def _index(
    album: Album,
    days: Sequence[str],
    rows: Sequence[VehicleRow],
    views: Mapping[str, Any],
    charted: tuple[Sequence[Edge], Iterable[tuple[str, dict[str, Any]]]],
) -> dict[str, Any]:
    """Input of `templates/fleet.js`; `charted`: edges, and each vehicle's charts of them."""
    edges, charts = charted
    sentences: dict[str, int] = {}
    told = [index_row(row, sentences, views.get(row.vehicle)) for row in rows]
    folder = album.page.parent / f"{album.page.stem}_charts"
    if len(rows) <= _CHARTS:
        where: dict[str, Any] = {"inside": dict(charts)}
    else:
        where = {"folder": quote(folder.name), "of": _write_charts(album, folder, rows, charts)}
    return {
        "days": list(days),
        "folder": quote(album.folder.name),
        "statuses": DRIFT_STATUSES,
        "words": DAY_LETTERS,
        "pairs": [edge.name for edge in edges],
        "dofs": [[dof_title(edge.kind, dof) for dof in DOF_NAMES] for edge in edges],
        "rows": told,
        "sentences": list(sentences),
        "charts": where,
    }


def _write_charts(
    album: Album, folder: PurePath, rows: Sequence[VehicleRow], charts: Iterable[tuple[str, dict[str, Any]]]
) -> list[str]:
    """Write the charts' numbers in files of a few dozen vehicles; returns the file of each vehicle.

    A vehicle stays in its file if others come and go.
    """
    count = 1 << max(0, (len(rows) - 1) // _VEHICLES_A_FILE).bit_length()
    file_of = {row.vehicle: f"{count}-{zlib.crc32(row.vehicle.encode()) % count:04d}.js" for row in rows}
    parts: dict[str, dict[str, Any]] = {name: {} for name in file_of.values()}
    for vehicle, chart in charts:
        parts[file_of[vehicle]][vehicle] = chart
    for name, part in parts.items():
        with album.files.replacing(folder / name) as stream:
            stream.write(f"boresightCharts({json.dumps(part, separators=(',', ':'))});\n".encode())
    for path in list(album.files.find(folder, "*.js")):
        if path.name not in parts:  # of when the fleet had another size
            album.files.delete(path)
    return [file_of[row.vehicle] for row in rows]


def _events_since(lake: Lake, first: str | None) -> list[ServiceEvent]:
    """Service events, the latest first."""
    found = current_events(read_records(lake, SERVICE_EVENTS, ServiceEvent, first=first))
    return sorted(found, key=lambda e: (e.day, e.vehicle), reverse=True)


def _provenance(window: FleetWindow, verdicts: FleetVerdicts) -> list[tuple[str, str]]:
    keys = verdicts.work_keys
    more = f" and {len(keys) - _WORK_KEYS} more" if len(keys) > _WORK_KEYS else ""
    return [
        ("calibration records", str(len(window.work_key))),
        ("audited until", ", ".join(verdicts.audited) or "not audited"),
        ("audit work keys", ", ".join(keys[:_WORK_KEYS]) + more),
        ("code version", ", ".join(window.code_versions)),
    ]
