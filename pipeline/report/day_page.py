"""The page of one vehicle-day, and its richest frame as a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from markupsafe import Markup

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError, DamagedError
from pipeline.core.results import plain
from pipeline.core.sections import ReportConfig
from pipeline.report.day import (
    Answered,
    answer_for,
    answered,
    pair_view,
    sigmas_of,
    status_sentence,
)
from pipeline.report.motion_view import motion_pictures
from pipeline.report.page import render, write_page
from pipeline.report.pictures import scene_pictures, write_picture
from pipeline.report.reading import (
    day_poses,
    day_records,
    drawn_records,
    drift_of,
    has_frames,
    names_drawn,
    other_cameras,
    scenes_among,
    spread_observations,
    states_of,
    vehicle_states,
)
from pipeline.report.residuals import MEASURES, TimeOffsets, as_stamped, frame_residuals, time_offsets_of
from pipeline.report.rig_figure import rig_of_day
from pipeline.report.svg import MUTED, Plot, document, nice_step
from pipeline.report.words import PAIR_TITLES, dof_title, pose_text, scaled, sigma_text, unit_of
from pipeline.store.corrections import read_corrections
from pipeline.store.current import state_values
from pipeline.store.files import Files, LocalFiles
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import DOF_NAMES, PAIRS, CalibrationRecord, pairs_of
from schemas.drift import DriftFinding
from schemas.states import StateRow
from schemas.words import day_word

__all__ = ["DayRead", "write_day_page", "write_day_picture"]

_SCENES = 3
P = TypeVar("P", bound=PurePath)
BEFORE, AFTER = "#e0813a", "#3b82c4"
_COLUMNS, _SIGMA_HEIGHT = 3, 272.0  # edges side by side, and the height of a row of them


@dataclass(frozen=True)
class DayRead:
    """Input of the page of a vehicle-day: its current records by edge, the vehicle's current findings and states.

    `mend`: what must be corrected first, if anything.
    """

    records: Mapping[str, CalibrationRecord]
    findings: Sequence[DriftFinding]
    states: Sequence[StateRow] = ()
    mend: str = ""


def write_day_page(
    lake: Lake,
    partition: Partition,
    fleet: FleetConfig,
    out: P,
    method: str | None = None,
    *,
    fleet_link: str = "",
    pictures: bool = True,
    read: DayRead | None = None,
    in_use: Mapping[str, Any] | None = None,
    files: Files | None = None,
) -> P:
    """Write the page of one vehicle-day.

    Args:
        lake: holds calibrations; observations and frames where there shall be pictures.
        fleet_link: relative link to the fleet page; empty = none.
        pictures: False = no pictures, and nothing else that is drawn from frames.
        read: the day's records and the vehicle's findings, if the caller has read them; None = read here.
        in_use: result of `boresight verify`, which the page then shows first.
        files: storage of `out`; None = this machine.

    Raises:
        ConfigError: the day has no record of the method.
    """
    method = method or fleet.audit.method
    if read is None:
        read = DayRead(
            day_records(lake, partition, method),
            drift_of(lake, method, partition.vehicle),
            vehicle_states(lake, partition.vehicle, method),
            read_corrections(lake).get(partition.vehicle, ""),
        )
    shown = _content(lake, partition, read, fleet.report if pictures else None)
    html = render(
        "day.html" if in_use is None else "in_use.html",
        in_use=in_use,
        vehicle=partition.vehicle,
        day=partition.day,
        fleet=fleet.fleet.name,
        fleet_link=fleet_link,
        method=method,
        **shown,
    )
    return write_page(out, html, files or LocalFiles())


def write_day_picture(
    lake: Lake, partition: Partition, fleet: FleetConfig, out: Path, method: str | None = None
) -> Path:
    """Write the day's richest frame as a still of prior and result, or as a picture that moves between them.

    Args:
        out: .jpg or .png: still; .webp (smaller) or .gif: moving.

    Raises:
        ConfigError: the day has no record of the method, nothing to draw, or `out` has another suffix.
    """
    records = day_records(lake, partition, method or fleet.audit.method)
    drawn = drawn_records(records)
    states = states_of(drawn)
    chosen = names_drawn(drawn)
    spread = spread_observations(lake, partition, chosen) if has_frames(lake, partition) else []
    if states is None or not any("camera" in o.sensors for o in spread):
        problem = f"{partition.vehicle} has no image with a prior on {partition.day}"
        raise ConfigError("command line", "picture", problem)
    before, after = states
    seen = [o for o in spread if "camera" in o.sensors]
    scene = scenes_among(lake, partition, seen, after.T_camera_lidar, 1, fleet.report, chosen)[0]
    stamped = as_stamped(after, scene.observation, time_offsets_of(drawn))
    labels = ("prior", _after_label(records))
    return write_picture(out, scene, before, stamped, labels)


def _content(
    lake: Lake, partition: Partition, read: DayRead, pictures: ReportConfig | None
) -> dict[str, Any]:
    """Values for the template, by name, from the records, the findings and the frames of a day."""
    records, findings = read.records, read.findings
    poses = day_poses(lake, partition, records)
    views = [pair_view(record) for record in records.values()]
    of_three, labels = drawn_records(records), ("prior", _after_label(records))
    drawn, residual_svg, no_pictures = (
        _pictures(lake, partition, of_three, labels, pictures)
        if pictures is not None
        else ([], "", "this page was requested without pictures")
    )
    if pictures is not None:
        for camera in other_cameras(records, of_three):
            drawn += _pictures(lake, partition, drawn_records(records, camera), labels, pictures, 1)[0]
    moving = [] if pictures is None else motion_pictures(lake, partition, records.values(), pictures)
    edges = [Answered(v["title"], v["status"], v["sensors"], v["certified"]) for v in views]
    load = _to_load(read.states, partition.day)
    loaded = [
        Answered(row["sensor"], row["status"], (row["sensor"],), ", ".join(row["determined"]))
        for row in (load["sensors"] if load else ())
    ]
    return {
        "environment": next(iter(records.values())).environment,
        "answer": answer_for(answered(edges, poses), partition.day, findings, loaded),
        "drift": _as_of(read, lake),
        "load": load,
        "pairs": views,
        "labels": labels,
        "scenes": drawn,
        "motions": moving,
        "no_pictures": no_pictures,
        "offsets": time_offsets_of(of_three).in_words(),
        "rig_svg": rig_of_day(poses, records.values()),
        "sigma_svg": _sigma_figure(list(records.values())),
        "residual_svg": residual_svg,
        "provenance": _provenance(list(records.values())),
    }


def _to_load(states: Sequence[StateRow], day: str) -> dict[str, Any] | None:
    """What the vehicle should load, as `boresight state --json` has it; None on pages of earlier days."""
    values = state_values(states)
    last = max((d for row in values for d in (*row["days"], "")), default="")
    if not values or day not in (last, values[0]["day"]):
        return None
    shown = [row for row in values if row["sensor"] is not None and row["sensor"] != row["parent_frame"]]
    return {
        "day": values[0]["day"],
        "reference": next((row["parent_frame"] for row in shown), ""),
        "sensors": [row | {"pose": pose_text(row["T"]), "sigma": sigma_text(row)} for row in shown],
        "json": json.dumps(plain(values)),
    }


def _as_of(read: DayRead, lake: Lake) -> tuple[str, str]:
    """The vehicle's status and the day of its audit: pages of days are not redrawn for every audit."""
    status, sentence = status_sentence(read.findings, lake, read.mend)
    return status, f"{sentence} (Audited until {read.findings[0].day}.)" if read.findings else sentence


def _after_label(records: Mapping[str, CalibrationRecord]) -> str:
    word = day_word(r.status for r in records.values())
    return "calibrated" if word == "done" else f"result, {word}{' accepted' * (word == 'partly')}"


def _pictures(
    lake: Lake,
    partition: Partition,
    records: Mapping[str, CalibrationRecord],
    labels: tuple[str, str],
    config: ReportConfig,
    count: int = _SCENES,
) -> tuple[list[dict[str, Any]], Any, str]:
    """Pictures, residuals, and why there are none; the result is drawn with its time offsets, the prior without."""
    states, offsets = states_of(records), time_offsets_of(records)
    if states is None:
        return [], "", "the records carry no prior"
    (before, after), chosen = states, names_drawn(records)
    try:
        if not has_frames(lake, partition):
            return [], "", "the lake no longer has the day's frames and observations"
        spread = spread_observations(lake, partition, chosen)
        if not spread:
            return [], "", "no frame of the day could be used"
        at_prior, at_result = frame_residuals(spread, states, (TimeOffsets(), offsets))
        there = [pair for pair in PAIRS if any(pair in pairs_of(o.sensors) for o in spread)]
        residuals = _residual_figure(at_prior, at_result, there)
        scenes = scenes_among(lake, partition, spread, after.T_camera_lidar, count, config, chosen)
    except DamagedError as err:
        lake.damage.append(str(err))
        return [], "", "the day's frames or observations cannot be read"
    camera = "" if chosen is None else chosen.get("camera", "")
    at_stamp = [(s, before, as_stamped(after, s.observation, offsets)) for s in scenes]
    pictures = [scene_pictures(*of, labels, camera) for of in at_stamp]
    return pictures, residuals, "no frame of the day could be drawn"


def _provenance(records: Sequence[CalibrationRecord]) -> list[tuple[str, str]]:
    return [
        ("work keys", ", ".join(sorted({r.work_key for r in records}))),
        ("code version", ", ".join(sorted({r.code_version for r in records}))),
        ("seed", ", ".join(sorted({str(r.seed) for r in records}))),
        ("inputs", ", ".join(sorted({i for r in records for i in r.inputs}))),
    ]


def _sigma_figure(records: Sequence[CalibrationRecord]) -> Markup:
    """Sigma of each DoF next to that of the prior, on a log scale; hollow if the day did not determine it."""
    parts: list[str] = []
    for place, record in enumerate(records):
        prior, sigma = sigmas_of(record)
        known = [source for source in (prior, sigma) if source is not None]
        left, above = place % _COLUMNS * 410.0, place // _COLUMNS * _SIGMA_HEIGHT
        for row, dofs in enumerate((DOF_NAMES[:3], DOF_NAMES[3:])):
            values = [
                scaled(s, dof) for source in known for s, dof in zip(source[3 * row :], dofs, strict=False)
            ]
            # With room for bars on the left and numbers on the right.
            low = float(np.log10(min(values))) - 0.5 if values else -3.0
            high = float(np.log10(max(values))) + 0.9 if values else 1.0
            plot = Plot(left + 80.0, above + row * 132.0 + 24.0, 310.0, 84.0, (low, high), (3.0, 0.0))
            if row == 0:
                title = f"{record.parent_frame}-{record.child_frame}"
                plot.text(left, above + 12.0, title, bold=True, size=12.5)
            decades = [(float(d), f"{10.0**d:g}") for d in np.arange(np.ceil(low), high + 1e-9)]
            plot.frame(decades, [])
            unit = f"sigma [{unit_of(dofs[0])}], log"
            plot.text(plot.left + 310, plot.top + 110, unit, anchor="end", colour=MUTED)
            for k, dof in enumerate(dofs):
                plot.text(plot.left - 6, plot.top + 28 * k + 18, dof_title(record.pair, dof), anchor="end")
                _sigma_bars(plot, k, 3 * row + k, record, prior, sigma)
            parts += plot.parts
    height = _SIGMA_HEIGHT * max(1, -(-len(records) // _COLUMNS))
    return document(1210.0, height, parts, "Sigma of each degree of freedom, of the prior and of the result")


def _sigma_bars(
    plot: Plot,
    row: int,
    k: int,
    record: CalibrationRecord,
    prior: np.ndarray | None,
    sigma: np.ndarray | None,
) -> None:
    low, dof = plot.x[0], DOF_NAMES[k]
    if prior is not None:
        end = float(np.log10(scaled(prior[k], dof)))
        plot.area((low, row + 0.48), (end, row + 0.14), MUTED, 0.45)
    if sigma is None:
        return
    value, observable = scaled(sigma[k], dof), record.observable is None or record.observable[k]
    end = float(np.log10(value))
    plot.area((low, row + 0.88), (end, row + 0.54), AFTER, 1.0 if observable else 0.0, AFTER)
    u, v = plot.at(end, row + 0.71)
    plot.text(u + 5, v + 3.5, f"{value:.2g}" + ("" if observable else " not determined"), size=10.0)


def _residual_figure(
    before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], pairs: Sequence[str]
) -> Markup:
    """Measures of `frame_residuals` over the day's frames."""
    parts: list[str] = []
    for column, pair in enumerate(pairs):
        finite = np.concatenate([v[np.isfinite(v)] for v in (before[pair], after[pair])])
        # A few frames in poor surroundings must not flatten the rest.
        top = 1.1 * float(np.quantile(finite, 0.97)) if len(finite) else 1.0
        plot = Plot(
            column * 410.0 + 44.0, 40.0, 350.0, 130.0, (-1.0, float(len(before[pair]))), (0.0, max(top, 1e-6))
        )
        plot.text(column * 410.0, 12.0, PAIR_TITLES[pair], bold=True, size=12.5)
        plot.text(column * 410.0, 28.0, f"{MEASURES[pair]}; more is better", colour=MUTED)
        step = nice_step(plot.y[1])
        plot.frame([], [(float(y), f"{y:g}") for y in np.arange(0.0, plot.y[1], step)])
        if not len(finite):
            plot.text(plot.left + 175, 110.0, "too little in view", anchor="middle")
        for k, (series, colour, label) in enumerate(
            ((before, BEFORE, "prior"), (after, AFTER, "calibrated"))
        ):
            _residual_dots(plot, series[pair], colour, label, plot.left + 130 * k)
        parts += plot.parts
    return document(
        1210.0,
        192.0,
        parts,
        "Agreement of the sensors in each frame, at the prior and calibrated",
    )


def _residual_dots(plot: Plot, values: np.ndarray, colour: str, label: str, legend_u: float) -> None:
    if not np.isfinite(values).any():
        return
    level = float(np.nanmedian(values))
    for i in np.flatnonzero(np.isfinite(values)):
        y = min(float(values[i]), plot.y[1])
        plot.dot(float(i), y, colour, f"{label}: {values[i]:.3g}", radius=2.3, opacity=0.65)
    plot.line((plot.x[0], min(level, plot.y[1])), (plot.x[1], min(level, plot.y[1])), colour, 1.6)
    plot.text(legend_u, 186.0, f"{label}: median {level:.2g}", colour=colour, bold=True)
