"""A fleet.toml for some logs: survey, sensors, and the meaning of the radars' values."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config import FleetConfig, validated
from pipeline.errors import ConfigError
from pipeline.geometry.transform_tree import TransformTree
from pipeline.ingest.captures import Rejected
from pipeline.ingest.index import index_logs
from pipeline.ingest.moments import MomentBuilder
from pipeline.ingest.propose.doppler import doppler_period, doppler_sign
from pipeline.ingest.propose.fleet_file import Facts, RadarMeaning, fleet_text, names_of
from pipeline.ingest.propose.sensors import FoundCamera, FoundCloud, FoundSensors, find_sensors
from pipeline.ingest.propose.survey import Survey, survey_logs
from pipeline.ingest.rig_sample import RigSample
from pipeline.ingest.stage import pick_moments
from pipeline.results import Progress, silent
from pipeline.rig.rig import Rig
from pipeline.store.views import logged_stars
from schemas.frames import Frame
from schemas.observations import WITHOUT_LABELS

__all__ = ["Proposal", "propose_fleet"]

_SAMPLE = 30  # moments on which the Doppler is tested
_VEHICLE_FRAMES = ("base_link", "base_footprint", "vehicle", "ego_vehicle", "rear_axle", "imu_link")


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
        seen = ", ".join(f"{t.name} ({t.msgtype})" for t in survey.topics.values()) or "no topic that is read"
        said = "; ".join([f"there are {seen}", *survey.problems[:3], *found.passed_over[:5]])
        raise ConfigError(str(logs[0]), "LOG", f"fewer than two of camera, lidar and radar; {said}")
    static, tree = _static(survey)
    tied_to = next((s.frame_id for s in [*found.lidars, *found.radars] if s.frame_id), "")
    untied = {n: s.frame_id for n, s in names.items() if tree.lookup(tied_to, s.frame_id) is None}
    frames = [f for f in _VEHICLE_FRAMES if tree.lookup(tied_to, f) is not None]

    def text(meanings: Mapping[str, RadarMeaning]) -> str:
        return fleet_text(fleet, found, names, Facts(static, untied, frames, meanings))

    meanings = _meanings(survey.logs, text({}), found, names, progress)
    cameras = {n: s for n, s in names.items() if isinstance(s, FoundCamera)}
    unlabelled = [n for n, s in cameras.items() if not (s.labels and s.detections)]
    missing = [f"{n}: semantics (recommended; {WITHOUT_LABELS})" for n in unlabelled]
    missing += ["prior: transforms between the sensors"] if untied or not static else []
    missing += [f"{n}: the Doppler's sign" for n, m in meanings.items() if not m.positive]
    return Proposal(text(meanings), tuple(names), tuple(missing), tuple(survey.logs), tuple(survey.problems))


def _static(survey: Survey) -> tuple[str, TransformTree]:
    """Topic of static transforms and its tree: frames never move on it, and it has the most of them."""
    still = {name: tree for name, tree in survey.transforms.items() if not tree.twice and tree.edges}
    name = max(still, key=lambda n: (n == "/tf_static", len(still[n].edges)), default="")
    return name, still.get(name, TransformTree())


def _meanings(
    logs: Sequence[Path],
    text: str,
    found: FoundSensors,
    names: Mapping[str, FoundCamera | FoundCloud],
    progress: Progress,
) -> dict[str, RadarMeaning]:
    """Doppler of each radar, tested on moments of the logs."""
    radars = {n: s for n, s in names.items() if isinstance(s, FoundCloud) and s in found.radars}
    can_be_tried = {n for n, s in radars.items() if len(s.doppler) == 1 or not s.fields}
    fleet = validated(FleetConfig, tomllib.loads(text), "fleet.toml")
    rig = fleet.rigs["default"]
    if not can_be_tried:
        return {}
    sample = _sample(logs, rig, fleet, progress)
    lidar = next(iter(rig.lidars), "")
    meanings = {}
    for name in sorted(can_be_tried):
        chosen = {"radar": name} | ({"lidar": lidar} if lidar else {})
        frames = [f for f in sample.frames(chosen) if "radar" in f.sensors]
        meanings[name] = _meaning(frames, rig.of_sensors([name]))
    return meanings


def _meaning(frames: Sequence[Frame], rig: Rig) -> RadarMeaning:
    period = doppler_period(frames)
    ((name, radar),) = rig.radars.items()
    wrapped = radar.model_copy(update={"doppler_period_mps": period})
    rig = rig.model_copy(update={"radars": {name: wrapped}})
    return RadarMeaning(doppler_sign(frames, rig), period, len(frames))


def _sample(logs: Sequence[Path], rig: Rig, fleet: FleetConfig, progress: Progress) -> RigSample:
    index = index_logs(logs, rig)
    try:
        anchored, _ = pick_moments(index, rig, fleet.ingest)
        builder = MomentBuilder(index, rig, fleet.ingest)
        built = []
        picked = np.unique(np.linspace(0, max(len(anchored) - 1, 0), _SAMPLE).round().astype(int))
        for done, i in enumerate(picked if anchored else [], 1):
            try:
                built.append(builder.build(anchored[i], int(i)))
            except Rejected as outcome:
                index.complain(str(outcome))
            progress(done, len(picked), "moments tried")
    finally:
        index.close()
    present = [frozenset(a.places) for a in anchored]
    return RigSample(rig, built, len(picked), present, logged_stars(builder.prior.rows()), None, {})
