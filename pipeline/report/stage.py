"""Stage report: tables to HTML pages, one per vehicle-day and one for the fleet."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pipeline.config import FleetConfig, config_hash
from pipeline.errors import ConfigError, DamagedError
from pipeline.report.day import PairView, answer_for, pair_view, sigmas_of, status_sentence
from pipeline.report.figures import drift_figure, residual_figure, sigma_figure
from pipeline.report.fleet import drift_panels, finding_views, headline_for, vehicle_rows
from pipeline.report.in_use import InUseView
from pipeline.report.overlays import Extrinsics
from pipeline.report.page import is_drawn, mark_drawn, render, write_page
from pipeline.report.picture_file import write_picture
from pipeline.report.pictures import scene_pictures
from pipeline.report.reading import (
    day_records,
    drift_of,
    fleet_records,
    has_frames,
    records_of_day,
    scenes_among,
    spread_observations,
    states_of,
)
from pipeline.report.residuals import frame_residuals
from pipeline.report.time_offsets import TimeOffsets, as_stamped, time_offsets_of
from pipeline.report.truth import truth_rows, truth_summary
from pipeline.results import Progress, silent
from pipeline.store.partitions import Lake, Partition
from pipeline.work import Run, Task, Work
from schemas.calibrations import DOF_NAMES, PAIRS, CalibrationRecord
from schemas.drift import DriftFinding
from schemas.versions import CODE_VERSION

__all__ = ["Pages", "work", "write_day_page", "write_day_picture", "write_fleet_page", "write_fleet_report"]

_SCENES = 3
_CHARTS = 24  # vehicles without an alarm whose charts still go on the fleet page


@dataclass(frozen=True)
class Pages:
    """What a task of this stage is given.

    Args:
        out: the HTML file to write.
        truth: of a simulated fleet.
        pictures: False = pages without images of public roads.
    """

    out: Path
    truth: Mapping[tuple[str, str], Mapping[str, np.ndarray]] | None = None
    pictures: bool = True


@dataclass(frozen=True)
class DayRead:
    """What the page of a vehicle-day tells: its current records by pair, and the vehicle's current findings."""

    records: Mapping[str, CalibrationRecord]
    findings: Sequence[DriftFinding]


def work(task: Task) -> Work:
    """The page of a vehicle-day, or those of the fleet with all its days, as `Pages` that the task is given says."""
    pages: Pages = task.given
    settings = ({"method": task.method or task.fleet.audit.method, "of": str(task.of)},)

    def rows(run: Run) -> Generator[Path, None, None]:
        if isinstance(task.of, Partition):
            yield write_day_page(
                task.lake, task.of, task.fleet, pages.out, task.method, pictures=pages.pictures
            )
        else:
            yield from write_fleet_report(
                task.lake,
                task.fleet,
                pages.out,
                task.method,
                truth=pages.truth,
                pictures=pages.pictures,
                progress=run.progress,
            )

    return Work(settings, rows, inputs=())


def write_day_page(
    lake: Lake,
    partition: Partition,
    fleet: FleetConfig,
    out: Path,
    method: str | None = None,
    *,
    fleet_link: str = "",
    pictures: bool = True,
    read: DayRead | None = None,
    in_use: InUseView | None = None,
) -> Path:
    """Write the page of one vehicle-day.

    Args:
        lake: holds calibrations; observations and frames where there shall be pictures.
        partition: the vehicle-day.
        fleet: names the fleet and the default method.
        out: the HTML file.
        method: None = `fleet.audit.method`.
        fleet_link: relative link to the fleet page; empty = none.
        pictures: False = none, and none of what is drawn from frames.
        read: the day's records and the vehicle's findings, where the caller has read them; None = read here.
        in_use: what `boresight verify` found: the page then answers its question first.

    Raises:
        ConfigError: the day has no record of the method.
    """
    method = method or fleet.audit.method
    if read is None:
        read = DayRead(day_records(lake, partition, method), drift_of(lake, method, partition.vehicle))
    records, findings = read.records, read.findings
    views = [pair_view(records[p]) for p in PAIRS if p in records]
    before, after = states_of(records) or (None, None)
    labels = ("prior", _after_label(views))
    offsets = time_offsets_of(records)
    drawn, residual_svg, no_pictures = (
        _pictures(lake, partition, before, after, labels, offsets)
        if pictures
        else ([], "", "this page was asked for without pictures")
    )
    html = render(
        "day.html" if in_use is None else "in_use.html",
        in_use=in_use,
        vehicle=partition.vehicle,
        day=partition.day,
        fleet=fleet.fleet.name,
        fleet_link=fleet_link,
        method=method,
        environment=next(iter(records.values())).environment,
        answer=answer_for(views, partition.day, findings),
        drift=status_sentence(findings),
        pairs=views,
        labels=labels,
        scenes=drawn,
        no_pictures=no_pictures,
        offsets=offsets.in_words(),
        sigma_svg=_sigma_svg(records),
        residual_svg=residual_svg,
        provenance=_provenance(list(records.values())),
    )
    return write_page(out, html)


def write_day_picture(
    lake: Lake, partition: Partition, fleet: FleetConfig, out: Path, method: str | None = None
) -> Path:
    """Write the day's richest frame as a picture: a still of prior and result, or one that moves between them.

    Args:
        lake: holds calibrations, observations and frames.
        partition: the vehicle-day.
        fleet: names the default method.
        out: .jpg or .png: still; .webp (smaller) or .gif: moving.
        method: None = `fleet.audit.method`.

    Raises:
        ConfigError: the day has no record of the method, nothing to draw, or `out` has another suffix.
    """
    records = day_records(lake, partition, method or fleet.audit.method)
    states = states_of(records)
    spread = spread_observations(lake, partition) if has_frames(lake, partition) else []
    if states is None or not spread:
        problem = f"{partition.vehicle} has no frame with a prior on {partition.day}"
        raise ConfigError("command line", "picture", problem)
    before, after = states
    scene = scenes_among(lake, partition, spread, after.T_camera_lidar, 1)[0]
    stamped = as_stamped(after, scene.observation, time_offsets_of(records))
    labels = ("prior", _after_label([pair_view(r) for r in records.values()]))
    return write_picture(out, scene, before, stamped, labels)


def write_fleet_page(
    lake: Lake,
    fleet: FleetConfig,
    out: Path,
    method: str | None = None,
    *,
    truth: Mapping[tuple[str, str], Mapping[str, np.ndarray]] | None = None,
    links: Mapping[tuple[str, str], str] | None = None,
) -> Path:
    """Write the page of the whole fleet: findings first, then vehicles x days, then charts.

    Args:
        lake: holds calibrations and drift.
        fleet: names the fleet and the default method.
        out: the HTML file.
        method: None = `fleet.audit.method`.
        truth: true extrinsics by (vehicle, day) and pair, where a simulated fleet has them.
        links: day pages by (vehicle, day), relative to `out`.
    """
    method = method or fleet.audit.method
    records = fleet_records(lake, method, fleet.audit.window_days)
    findings = drift_of(lake, method)
    days = sorted({r.day for r in records})
    views = finding_views(findings)
    rows = vehicle_rows(records, findings, days, links or {})
    alarmed = {v.vehicle for v in views}
    quiet = [r for r in rows if r.vehicle not in alarmed]
    shown = [r for r in rows if r.vehicle in alarmed] + quiet[:_CHARTS]
    known = truth_rows(records, truth) if truth else []
    html = render(
        "fleet.html",
        fleet=fleet.fleet.name,
        method=method,
        span=f"{days[0]} to {days[-1]}" if days else "no calibration record yet",
        headline=headline_for(findings, views),
        budget=_budget(fleet),
        findings=views,
        days=days,
        rows=rows,
        dofs=[f"{d} [{'deg' if d.startswith('r') else 'm'}]" for d in DOF_NAMES],
        truth=known,
        truth_summary=truth_summary(known),
        charts=[_chart(row.vehicle, row.status, records, findings, row.vehicle in alarmed) for row in shown],
        left_out=max(0, len(quiet) - _CHARTS),
        provenance=_fleet_provenance(records, findings),
    )
    return write_page(out, html)


def write_fleet_report(
    lake: Lake,
    fleet: FleetConfig,
    out: Path,
    method: str | None = None,
    *,
    truth: Mapping[tuple[str, str], Mapping[str, np.ndarray]] | None = None,
    pictures: bool = True,
    progress: Progress = silent,
) -> list[Path]:
    """Write the fleet page and, in a folder beside it, the page of every vehicle-day; the fleet page comes first.

    A day's page that lies there already, of the same records and the same status, is not drawn again.
    """
    method = method or fleet.audit.method
    records, findings = fleet_records(lake, method, fleet.audit.window_days), drift_of(lake, method)
    by_vehicle: dict[str, list[DriftFinding]] = {}
    for finding in findings:
        by_vehicle.setdefault(finding.vehicle, []).append(finding)
    keys: dict[Partition, list[str]] = {}
    for record in records:
        keys.setdefault(Partition(record.vehicle, record.day), []).append(record.work_key)
    names, folder = _page_names(keys), out.parent / f"{out.stem}_days"
    stamps = {
        p: config_hash({"keys": sorted(of), "drift": status_sentence(by_vehicle.get(p.vehicle, [])),
                        "pictures": pictures, "link": out.name, "code": CODE_VERSION})
        for p, of in keys.items()
    }  # fmt: skip
    stale = [
        p
        for p in sorted(keys, key=lambda p: (p.day, p.vehicle))
        if not is_drawn(folder / names[p], stamps[p])
    ]
    of_day: tuple[str, dict[str, dict[str, CalibrationRecord]]] = ("", {})
    for done, partition in enumerate(stale):
        progress(done, len(stale), f"{partition.vehicle} {partition.day}")
        if of_day[0] != partition.day:
            of_day = (partition.day, records_of_day(lake, method, partition.day))
        if partition.vehicle not in of_day[1]:  # its file went bad meanwhile: `lake.damage` says so
            continue
        read = DayRead(of_day[1][partition.vehicle], by_vehicle.get(partition.vehicle, []))
        path, link = folder / names[partition], f"../{quote(out.name)}"
        write_day_page(lake, partition, fleet, path, method, fleet_link=link, pictures=pictures, read=read)
        mark_drawn(path, stamps[partition])
    pages = {p: folder / names[p] for p in sorted(keys) if (folder / names[p]).exists()}
    links = {(p.vehicle, p.day): f"{quote(folder.name)}/{quote(path.name)}" for p, path in pages.items()}
    return [write_fleet_page(lake, fleet, out, method, truth=truth, links=links), *pages.values()]


def _page_names(partitions: Iterable[Partition]) -> dict[Partition, str]:
    """A file name for each vehicle-day: readable, and no two alike ("a b" and "a_b" are two vehicles)."""
    names = {}
    for partition in partitions:
        readable = re.sub(r"[^A-Za-z0-9._-]", "_", partition.vehicle)
        if readable != partition.vehicle:
            readable += f"-{config_hash({'vehicle': partition.vehicle})[:8]}"
        names[partition] = f"{readable}_{partition.day}.html"
    return names


def _after_label(views: Sequence[PairView]) -> str:
    statuses = {v.status for v in views}
    if statuses == {"accepted"}:
        return "calibrated"
    return "result, partly held" if "accepted" in statuses else "result, held"


def _pictures(
    lake: Lake,
    partition: Partition,
    before: Extrinsics | None,
    after: Extrinsics | None,
    labels: tuple[str, str],
    offsets: TimeOffsets,
) -> tuple[list[Any], Any, str]:
    """Pictures, residuals, and why there are none; `after` is drawn with the day's time offsets, `before` had none."""
    if before is None or after is None:
        return [], "", "the records carry no prior"
    try:
        return _drawn(lake, partition, before, after, labels, offsets)
    except DamagedError as err:
        lake.damage.append(str(err))
        return [], "", "the day's frames or observations cannot be read"


def _drawn(
    lake: Lake,
    partition: Partition,
    before: Extrinsics,
    after: Extrinsics,
    labels: tuple[str, str],
    offsets: TimeOffsets,
) -> tuple[list[Any], Any, str]:
    """Pictures, residuals, and why there are none.

    Raises:
        DamagedError: a file cannot be read.
    """
    if not has_frames(lake, partition):
        return [], "", "the lake no longer has the day's frames and observations"
    spread = spread_observations(lake, partition)
    if not spread:
        return [], "", "no frame of the day could be used"
    residuals = residual_figure(*frame_residuals(spread, (before, after), (TimeOffsets(), offsets)))
    scenes = scenes_among(lake, partition, spread, after.T_camera_lidar, _SCENES)
    pictures = [
        scene_pictures([s], before, as_stamped(after, s.observation, offsets), labels)[0] for s in scenes
    ]
    return pictures, residuals, "no frame of the day could be drawn"


def _sigma_svg(records: Mapping[str, CalibrationRecord]) -> str:
    prior, sigma, observable = {}, {}, {}
    for pair, record in records.items():
        before, after = sigmas_of(record)
        if before is not None:
            prior[pair] = before
        if after is not None:
            sigma[pair] = after
            observable[pair] = record.observable or [True] * 6
    return sigma_figure(prior, sigma, observable)


def _chart(
    vehicle: str,
    status: str,
    records: Sequence[CalibrationRecord],
    findings: Sequence[DriftFinding],
    alarmed: bool,
) -> dict[str, Any]:
    panels = drift_panels(vehicle, records, findings)
    ordinals = {dt.date.fromisoformat(r.day).toordinal(): r.day[5:] for r in records if r.vehicle == vehicle}
    if not panels or not ordinals:
        svg: str = "No record in the window."
    else:
        svg = drift_figure(panels, ordinals, vehicle)
    return {"vehicle": vehicle, "status": status, "svg": svg, "open": alarmed}


def _budget(fleet: FleetConfig) -> str:
    rate = fleet.audit.false_alarms_per_1000_vehicle_days
    text = f"False alarms expected: at most {rate:g} in 1000 vehicle-days over all charts"
    return f"{text}, as far as the sigmas are honest."


def _provenance(records: Sequence[CalibrationRecord]) -> list[tuple[str, str]]:
    return [
        ("work keys", ", ".join(sorted({r.work_key for r in records}))),
        ("code version", ", ".join(sorted({r.code_version for r in records}))),
        ("seed", ", ".join(sorted({str(r.seed) for r in records}))),
        ("inputs", ", ".join(sorted({i for r in records for i in r.inputs}))),
    ]


def _fleet_provenance(
    records: Sequence[CalibrationRecord], findings: Sequence[DriftFinding]
) -> list[tuple[str, str]]:
    return [
        ("calibration records", str(len(records))),
        ("audited until", ", ".join(sorted({f.day for f in findings})) or "not audited"),
        ("audit work keys", ", ".join(sorted({f.work_key for f in findings}))),
        ("code version", ", ".join(sorted({r.code_version for r in records}))),
    ]
