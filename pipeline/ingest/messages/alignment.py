"""Radar misalignment from radar messages; angles in radians, positive to the left and upwards.

Sources: off_highway_premium_radar_msgs (angles in rad, left and up positive for a radar mounted upright, NaN
if there is no estimate), continental_msgs of Nebula and ars548_messages (rad: neither states a unit; both
copy the number that the radar sends, and Nebula's decoder of the ARS548, nebula_decoders_continental, asserts
-pi to pi of it as of the angles beside it; neither states the sign), delphi_esr_msgs, delphi_mrr_msgs and
delphi_srr_msgs (deg, in steps of 0.0625).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from pipeline.errors import LogError
from pipeline.ingest.containers.reader import Channel
from pipeline.ingest.messages.decoding import decode
from pipeline.rigs import AlignmentFields

__all__ = ["ALIGNMENT_MESSAGES", "SIGNS_PUBLISHED", "Misalignment", "read_alignment"]

_BOSCH: Final = "location_attributes_packet.misalignment."
_OF_BOSCH: Final = AlignmentFields(
    azimuth=f"{_BOSCH}theta",
    azimuth_variance=f"{_BOSCH}theta_variance",
    elevation=f"{_BOSCH}phi",
    elevation_variance=f"{_BOSCH}phi_variance",
    status=f"{_BOSCH}status",
)
# Known types; for others fleet.toml names the fields.
ALIGNMENT_MESSAGES: Final = {
    "off_highway_premium_radar_msgs/msg/LocationAttributes": _OF_BOSCH,
    "off_highway_premium_radar_sample_msgs/msg/LocationAttributes": _OF_BOSCH,
    "continental_msgs/msg/ContinentalArs548DetectionList": AlignmentFields(
        azimuth="alignment_azimuth_correction",
        elevation="alignment_elevation_correction",
        status="alignment_status",
    ),
    "ars548_messages/msg/DetectionList": AlignmentFields(
        azimuth="aln_azimuthcorrection", elevation="aln_elevationcorrection", status="aln_status"
    ),
    "delphi_esr_msgs/msg/EsrStatus4": AlignmentFields(azimuth="auto_align_angle", unit="deg"),
    "delphi_esr_msgs/msg/EsrStatus6": AlignmentFields(elevation="vertical_misalignment", unit="deg"),
    "delphi_mrr_msgs/msg/MrrHeaderAlignmentState": AlignmentFields(
        azimuth="can_auto_align_hangle", status="can_alignment_status", unit="deg"
    ),
    "delphi_srr_msgs/msg/SrrStatus4": AlignmentFields(azimuth="can_tx_auto_align_angle", unit="deg"),
}
# types for which the manufacturer documents the signs
SIGNS_PUBLISHED: Final = frozenset(name for name, fields in ALIGNMENT_MESSAGES.items() if fields is _OF_BOSCH)


@dataclass(frozen=True)
class Misalignment:
    """One message: angles and sigmas [rad], None if not stated; status as logged."""

    azimuth_rad: float | None = None
    azimuth_sigma_rad: float | None = None
    elevation_rad: float | None = None
    elevation_sigma_rad: float | None = None
    status: str = ""


def read_alignment(channel: Channel, data: memoryview, fields: AlignmentFields | None = None) -> Misalignment:
    """Misalignment stated in a message; `fields` are names of its fields, None = those of its type.

    Raises:
        LogError: unknown type without field names, a field is missing or no number, or damaged bytes.
    """
    known = fields or ALIGNMENT_MESSAGES.get(channel.msgtype)
    if known is None:
        problem = (
            f"{channel.msgtype} is not a known alignment message: name its fields, alignment_fields = {{...}}"
        )
        raise LogError("", problem, topic=channel.topic)
    message = decode(channel, data)
    unit = 1.0 if known.unit == "rad" else math.pi / 180

    def number(path: str | None) -> float | None:
        value = None if path is None else _value(channel, message, path)
        return value if value is not None and math.isfinite(value) else None

    def angle(path: str | None, variance: str | None) -> tuple[float | None, float | None]:
        value, spread = number(path), number(variance)
        if value is None:
            return None, None
        return unit * value, unit * math.sqrt(spread) if spread is not None and spread > 0 else None

    status = "" if known.status is None else f"{_value(channel, message, known.status):g}"
    return Misalignment(
        *angle(known.azimuth, known.azimuth_variance),
        *angle(known.elevation, known.elevation_variance),
        status,
    )


def _value(channel: Channel, message: Any, path: str) -> float:
    """Number at a path of a message."""
    value, sign = message, -1.0 if path.startswith("-") else 1.0
    for name in path.lstrip("-").split("."):
        if not hasattr(value, name):
            has = ", ".join(n for n in getattr(value, "__dataclass_fields__", {}) if not n.startswith("__"))
            problem = (
                f"{channel.msgtype} has no {name} there, only {has or 'a number'}: correct alignment_fields"
            )
            raise LogError("", problem, topic=channel.topic, field=path.lstrip("-"))
        value = getattr(value, name)
    try:
        return sign * float(value)
    except (TypeError, ValueError) as err:
        field = path.lstrip("-")
        raise LogError(
            "", f"{channel.msgtype}: this is not a number", topic=channel.topic, field=field
        ) from err
