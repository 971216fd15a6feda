"""A fleet.toml for some logs: survey, sensors, and the meaning of the radars' values; its text."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.core.config import FleetConfig, validated
from pipeline.core.errors import ConfigError
from pipeline.core.models import semantics_line
from pipeline.core.results import Progress, silent
from pipeline.ingest.directions_and_units import AskedRadar, doppler_speed, motion_of, opposed_signs
from pipeline.ingest.index import index_logs
from pipeline.ingest.messages.point_cloud import TIME_FIELDS
from pipeline.ingest.moments import MomentBuilder, spread
from pipeline.ingest.propose.sensors import FoundCamera, FoundCloud, FoundSensors, find_sensors
from pipeline.ingest.propose.survey import Survey, survey_logs
from pipeline.ingest.rig_sample import RigSample
from pipeline.ingest.stage import pick_moments
from pipeline.rig.rig import Rig
from pipeline.rig.transform_tree import TransformTree
from pipeline.store.views import logged_stars
from schemas.frames import Frame
from schemas.observations import WITHOUT_LABELS

__all__ = [
    "Proposal",
    "RadarMeaning",
    "doppler_period",
    "fleet_text",
    "left_out",
    "names_of",
    "propose_fleet",
]

_SAMPLE = 30  # moments on which the Doppler is tested
_VEHICLE_FRAMES = ("base_link", "base_footprint", "vehicle", "ego_vehicle", "rear_axle", "imu_link")
_FEWEST_SCANS = 3  # scans that no speed explains without a period
_HALF = 0.5  # share of a scan's detections explained by one speed: then no period is needed
# increase of the explained share by a period, and share of scans with that increase
_MORE, _MOST = 0.1, 2 / 3
_MOST_STEPS = 4096  # most distinct values of a quantised Doppler; with more it is not quantised


@dataclass(frozen=True)
class Proposal:
    """Text of the file, the readable logs, and the problems."""

    text: str
    sensors: tuple[str, ...]
    missing: tuple[str, ...]
    logs: tuple[Path, ...]
    problems: tuple[str, ...]


def propose_fleet(logs: Sequence[Path], fleet: str, progress: Progress = silent) -> Proposal:
    """A fleet.toml for logs of vehicles of one build; one minute of each log is read.

    Raises:
        ConfigError: the logs have fewer than two sensors.
    """
    survey = survey_logs(logs, progress)
    found = find_sensors(survey)
    names = names_of(found)
    if len(names) < 2:
        seen = ", ".join(f"{t.name} ({t.msgtype})" for t in survey.topics.values())
        said = [*survey.problems[:3], *left_out(found)[:3], *found.passed_over[:5]]
        said += [f"fewer than two of camera, lidar and radar; there are {seen or 'no topics'}"]
        raise ConfigError("command line", "LOG", "; ".join(said))
    static, tree = _static(survey)
    tied_to = next((s.frame_id for s in [*found.lidars, *found.radars] if s.frame_id), "")
    untied = {n: s.frame_id for n, s in names.items() if tree.lookup(tied_to, s.frame_id) is None}
    base = next((f for f in _VEHICLE_FRAMES if tree.lookup(tied_to, f) is not None), None)
    text = partial(fleet_text, fleet, found, names, static, untied, base)
    meanings = _meanings(survey, text({}), found, names, base, progress)
    signs = opposed_signs({name: m.positive for name, m in meanings.items()})
    problems = [*survey.problems, *left_out(found), *signs]
    problems += [f"{n}: {p}" for n, m in meanings.items() for p in m.problems]
    cameras = {n: s for n, s in names.items() if isinstance(s, FoundCamera)}
    unlabelled = [n for n, s in cameras.items() if not (s.labels and s.detections)]
    missing = [f"{n}: semantics (recommended; {WITHOUT_LABELS})" for n in unlabelled]
    missing += ["prior: transforms between the sensors"] if untied or not static else []
    missing += [f"{n}: the Doppler's sign" for n, m in meanings.items() if m.has_sign and not m.positive]
    return Proposal(text(meanings), tuple(names), tuple(missing), tuple(survey.logs), tuple(problems))


def _static(survey: Survey) -> tuple[str, TransformTree]:
    """Topic of static transforms and its tree: frames never move on it, and it has the most of them."""
    still = {name: tree for name, tree in survey.transforms.items() if not tree.twice and tree.edges}
    name = max(still, key=lambda n: (n == "/tf_static", len(still[n].edges)), default="")
    return name, still.get(name, TransformTree())


def _meanings(
    survey: Survey, text: str, found: FoundSensors, names: Mapping[str, FoundCamera | FoundCloud],
    base: str | None, progress: Progress,
) -> dict[str, RadarMeaning]:  # fmt: skip
    """Doppler of each radar, tested on moments of the logs, in the direction in which it looks by tf."""
    radars = {n: s for n, s in names.items() if isinstance(s, FoundCloud) and s in found.radars}
    can_be_tried = [n for n, s in sorted(radars.items()) if len(s.doppler) == 1 or not s.fields]
    if not can_be_tried:
        return {}
    fleet = validated(FleetConfig, tomllib.loads(text), "fleet.toml")
    sample = _sample(survey.logs, fleet.rigs["default"].model_copy(update={"base": base}), fleet, progress)
    tracked = [n for n in can_be_tried if radars[n].msgtype.endswith("RadarTracks")]
    return {n: _meaning(replace(sample, tracked=tracked), n) for n in can_be_tried}


def _meaning(sample: RigSample, radar: str) -> RadarMeaning:
    lidar = next(iter(sample.rig.lidars), "")
    frames = [f for f in sample.frames({"radar": radar, "lidar": lidar}) if "radar" in f.sensors]
    asked = sample.asked(radar)
    period = doppler_period(frames, asked)
    asked = replace(asked, topics=asked.topics.model_copy(update={"doppler_period_mps": period}))
    if not asked.R_ahead_radar and len(sample.rig.radars) > 1:
        return RadarMeaning("", period, len(frames), has_sign=asked.has_sign)
    motion = motion_of(frames, asked)
    # A Doppler that another sign mends is no problem: this file is written with that sign.
    of_doppler = [motion.doppler_problem] if motion.doppler_problem and not motion.doppler_positive else []
    return RadarMeaning(
        motion.doppler_positive, period, len(frames), (*of_doppler, *motion.wrong), asked.has_sign
    )


def _sample(logs: Sequence[Path], rig: Rig, fleet: FleetConfig, progress: Progress) -> RigSample:
    index = index_logs(logs, rig)
    try:
        anchored, rejected = pick_moments(index, rig, fleet.ingest)
        builder = MomentBuilder(index, rig, fleet.ingest)
        picked = [anchored[i] for i in spread(len(anchored), _SAMPLE)]
        built = list(builder.built(picked, rejected, progress))
    finally:
        index.close()
    present = [frozenset(a.places) for a in anchored]
    return RigSample(rig, built, len(picked), present, logged_stars(builder.prior.rows()), None, {})


def doppler_period(frames: Sequence[Frame], radar: AskedRadar) -> float | None:
    """Aliasing period of the Doppler [m/s]; None if it is not aliased or the log does not show it.

    An aliased Doppler fills the range of one period for any speed of the car, so the observed range is tried.
    It is accepted if, in most scans that no speed explains without it, a static world explains more
    detections with it.
    """
    scans = [
        (radar.directions(f), f.radar_range_rate_mps.astype(np.float64))
        for f in frames
        if "radar" in f.sensors and len(f.radar_xyz_m)
    ]
    if len(scans) < _FEWEST_SCANS:
        return None
    values = np.unique(np.round(np.concatenate([rates for _, rates in scans]), 4))
    steps = np.diff(values)
    span = float(values[-1] - values[0])
    step = float(np.median(steps)) if len(steps) else 0.0
    if step <= 0:
        return None
    period = span + (step if span / step < _MOST_STEPS else 0.0)
    plain = np.array([doppler_speed(d, r, None)[1] for d, r in scans])
    wrapped = np.array([doppler_speed(d, r, period)[1] for d, r in scans])
    gained = (wrapped > plain + _MORE)[plain < _HALF]
    return period if len(gained) >= _FEWEST_SCANS and gained.mean() >= _MOST else None


_NO_NAME = re.compile(r"[^A-Za-z0-9_]+")
_ENDINGS = ("_optical_frame", "_optical", "_frame", "_link")
_COLUMN = 60  # column of comments behind a line


@dataclass(frozen=True)
class RadarMeaning:
    """Doppler of a radar in the log: sign ("" = undetermined), period if aliased [m/s], and problems.

    `has_sign` is False for messages whose velocities are vectors.
    """

    positive: str = ""
    period_mps: float | None = None
    scans: int = 0
    problems: tuple[str, ...] = ()
    has_sign: bool = True


def names_of(found: FoundSensors) -> dict[str, FoundCamera | FoundCloud]:
    """Sensors by name: their kind if there is one of each, else from frame ids."""
    of_kind: dict[str, Sequence[FoundCamera | FoundCloud]]
    of_kind = {"camera": found.cameras, "lidar": found.lidars, "radar": found.radars}
    if all(len(sensors) <= 1 for sensors in of_kind.values()):
        return {kind: sensors[0] for kind, sensors in of_kind.items() if sensors}
    names: dict[str, FoundCamera | FoundCloud] = {}
    for kind, sensors in of_kind.items():
        for sensor in sensors:
            name = own = _name(sensor.frame_id, kind)
            number = 1
            while name in names:
                number += 1
                name = f"{own}_{number}"
            names[name] = sensor
    return names


def fleet_text(
    fleet: str, found: FoundSensors, names: Mapping[str, FoundCamera | FoundCloud], static_topic: str,
    untied: Mapping[str, str], vehicle_frame: str | None, meanings: Mapping[str, RadarMeaning],
) -> str:  # fmt: skip
    """Text of the file for a fleet of that name.

    Args:
        untied: sensors that no chain of transforms reaches, with their frame ids.
        vehicle_frame: frame of the transforms that may be the vehicle's.
    """
    environment = Environment(
        loader=PackageLoader("pipeline.ingest.propose", "templates"),
        autoescape=False,  # noqa: S701 - no HTML
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"json": json.dumps, "beside": _beside}
    return environment.get_template("fleet.toml").render(
        fleet=fleet, found=found, names=names,
        is_short=all(name in ("camera", "lidar", "radar") for name in names), static_topic=static_topic,
        untied=", ".join(f"{name} ({frame or 'no frame id'})" for name, frame in untied.items()),
        base=vehicle_frame, meanings=meanings, unknown=RadarMeaning(), times=set(TIME_FIELDS),
        models=semantics_line("models"), left_out=left_out(found),
    )  # fmt: skip


def left_out(found: FoundSensors) -> list[str]:
    """Why cameras of the logs are not in the file, a sentence per camera."""
    return [
        f"Camera left out: no usable CameraInfo of {', '.join(images)} in these logs. Record it, with a calibrated K."
        for images in found.left_out.values()
    ]


def _beside(line: str, comment: str) -> str:
    return f"{line:<{_COLUMN}}# {comment}"


def _name(frame_id: str, kind: str) -> str:
    name = frame_id
    for ending in _ENDINGS:
        name = name.removesuffix(ending)
    name = _NO_NAME.sub("_", name).strip("_").lower()[:60]
    return name if name[:1].isalpha() else f"{kind}_{name}".rstrip("_")
