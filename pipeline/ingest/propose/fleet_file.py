"""Text of a fleet.toml for the sensors that were found: reliable values as lines, others as comments."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.core.models import semantics_line
from pipeline.ingest.messages.point_cloud import TIME_FIELDS
from pipeline.ingest.propose.sensors import FoundCamera, FoundCloud, FoundSensors

__all__ = ["RadarMeaning", "fleet_text", "left_out", "names_of"]

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
    environment = Environment(
        loader=PackageLoader("pipeline.ingest.propose", "templates"),
        autoescape=False,  # noqa: S701 - no HTML
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"json": json.dumps, "beside": _beside}
    return environment.get_template("fleet.toml").render(
        fleet=fleet,
        found=found,
        names=names,
        is_short=all(name in ("camera", "lidar", "radar") for name in names),
        static_topic=static_topic,
        untied=", ".join(f"{name} ({frame or 'no frame id'})" for name, frame in untied.items()),
        base=vehicle_frame,
        meanings=meanings,
        unknown=RadarMeaning(),
        times=set(TIME_FIELDS),
        models=semantics_line("models"),
        left_out=left_out(found),
    )


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
