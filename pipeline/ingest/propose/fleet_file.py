"""Text of a fleet.toml for the sensors that were found: reliable values as lines, others as comments."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipeline.core.models import semantics_line
from pipeline.ingest.messages.point_cloud import TIME_FIELDS
from pipeline.ingest.propose.sensors import FoundCamera, FoundCloud, FoundSensors

__all__ = ["RadarMeaning", "fleet_text", "left_out", "names_of"]

_NO_NAME = re.compile(r"[^A-Za-z0-9_]+")
_ENDINGS = ("_optical_frame", "_optical", "_frame", "_link")
_COLUMN = 60  # column of comments behind a line
_NO_TIMES = "# These clouds have no time per point. If the lidar turns, and its driver does not de-skew:"
_NO_ODOMETRY = '# odometry = "/..."     # none in these logs: speed comes from Doppler'


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
    fleet: str,
    found: FoundSensors,
    names: Mapping[str, FoundCamera | FoundCloud],
    static_topic: str,
    untied: Mapping[str, str],
    vehicle_frame: str | None,
    meanings: Mapping[str, RadarMeaning],
) -> str:
    """Text of the file for a fleet of that name.

    Args:
        untied: sensors that no chain of transforms reaches, with their frame ids.
        vehicle_frame: frame of the transforms that may be the vehicle's.
    """
    is_short = all(name in ("camera", "lidar", "radar") for name in names)
    lines = [
        "[fleet]",
        f"name = {json.dumps(fleet)}",
        *_of_rig(vehicle_frame, is_comment=is_short and bool(found.lidars)),
    ]
    for name, sensor in names.items():
        kind = "camera" if isinstance(sensor, FoundCamera) else "lidar" if sensor in found.lidars else "radar"
        lines += ["", f"[rigs.default.{kind if is_short else f'{kind}s.{name}'}]"]
        if isinstance(sensor, FoundCamera):
            lines += _camera(sensor)
        else:
            lines += [f"points = {json.dumps(sensor.topic)}"]
            if kind == "radar":
                lines += _radar(sensor, meanings.get(name, RadarMeaning()))
            elif sensor.fields and not set(sensor.fields) & set(TIME_FIELDS):
                lines += [_NO_TIMES, '# turn = { sense = "right", begins_deg = 180.0 }']
    if found.odometry:
        lines += ["", "[rigs.default.ego]", f"odometry = {json.dumps(found.odometry)}"]
    else:
        lines += ["", "# [rigs.default.ego]", _NO_ODOMETRY]
    lines += ["", *_prior(static_topic, untied), "", '[vehicles."*"]', 'rig = "default"']
    lines += ["", *(f"# {what}" for what in left_out(found))] if found.left_out else []
    if found.passed_over:
        lines += ["", "# Not used:", *(f"#   {what}" for what in sorted(found.passed_over))]
    return "\n".join(lines) + "\n"


def left_out(found: FoundSensors) -> list[str]:
    """Why cameras of the logs are not in the file, a sentence per camera."""
    return [
        f"Camera left out: no usable CameraInfo of {', '.join(images)} in these logs. Record it, with a calibrated K."
        for images in found.left_out.values()
    ]


def _of_rig(vehicle_frame: str | None, *, is_comment: bool) -> list[str]:
    """Lines on the vehicle frame, if it is logged: a comment where a lidar's x axis shows the way ahead."""
    if vehicle_frame is None:
        return []
    line = f"base = {json.dumps(vehicle_frame)}"
    if is_comment:
        return ["", "# [rigs.default]", _with(f"# {line}", "for poses on the vehicle, too")]
    return ["", "[rigs.default]", _with(line, "the vehicle's frame")]


def _camera(camera: FoundCamera) -> Iterator[str]:
    yield f"image = {json.dumps(camera.image)}"
    yield f"info = {json.dumps(camera.info)}"
    if not (camera.labels and camera.detections):
        only = "only label images" if camera.labels else "only detections" if camera.detections else ""
        has = only or "no label images or detections"
        yield f"# The logs have {has} of this camera; semantics are both. Without them, its borders are steps"
        yield "# of brightness, and it has no edge to a radar. Better: log both, or name two models, of yours or those"
        yield "# that `boresight models --fetch` downloads into models/ (mind their licences):"
        yield f"# {semantics_line('models')}"
        return
    known = "" if camera.label_set in ("cityscapes", "") else f', label_set = "{camera.label_set}"'
    topics = f"labels = {json.dumps(camera.labels)}, detections = {json.dumps(camera.detections)}"
    meaning = "Cityscapes train ids" if camera.label_set == "cityscapes" else camera.label_set
    if camera.label_set:
        yield f"# {camera.labels_say}: taken for {meaning}. If yours differ: label_set = {{ road = [7], car = [26] }}"
    else:
        yield f"# {camera.labels_say}: no set that is known. Enter label_set = {{ road = [7], car = [26] }}, as yours."
    yield f'semantics = {{ source = "topics", {topics}{known} }}'


def _radar(radar: FoundCloud, meaning: RadarMeaning) -> Iterator[str]:
    if len(radar.doppler) > 1:
        yield _with(
            f"velocity_fields = {json.dumps(list(radar.doppler))}", "relative to the radar, not over ground"
        )
        return
    if radar.fields and not radar.doppler:
        yield f'# doppler_field = "..."     # which of {", ".join(radar.fields)} is the speed along the line of sight?'
    elif radar.doppler:
        yield f"doppler_field = {json.dumps(radar.doppler[0])}"
    if meaning.positive and meaning.has_sign:
        shown = f"by {meaning.scans} scans: else the car drives backwards"
        yield _with(f'doppler_positive = "{meaning.positive}"', shown)
    elif not radar.msgtype.endswith("RadarTracks"):
        yield '# doppler_positive = "receding"     # or "approaching": undecided by these logs, see its data sheet'
    if meaning.period_mps is not None:
        yield _with(f"doppler_period_mps = {meaning.period_mps:.5g}", "the Doppler wraps at this")


def _prior(static_topic: str, untied: Mapping[str, str]) -> Iterator[str]:
    yield "[rigs.default.prior]"
    if untied or not static_topic:
        frames = ", ".join(f"{name} ({frame or 'no frame id'})" for name, frame in untied.items())
        why = f"No chain of transforms to {frames}" if static_topic else "The logs have no static transforms"
        yield f"# {why}. Log them, or write them down:"
        yield '# source = "file"'
        yield '# file = "prior.json"     # {"reference": SENSOR, "T": {SENSOR: 4x4, ...}}, or by `boresight import`'
    if static_topic not in ("", "/tf_static"):
        yield f"topic = {json.dumps(static_topic)}"
    yield _with("rotation_sigma_deg = 2.0", "how far off the prior may be (1 sigma)")
    yield "translation_sigma_m = 0.05"


def _with(line: str, comment: str) -> str:
    return f"{line:<{_COLUMN}}# {comment}"


def _name(frame_id: str, kind: str) -> str:
    name = frame_id
    for ending in _ENDINGS:
        name = name.removesuffix(ending)
    name = _NO_NAME.sub("_", name).strip("_").lower()[:60]
    return name if name[:1].isalpha() else f"{kind}_{name}".rstrip("_")
